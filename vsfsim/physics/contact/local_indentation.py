"""The indentation under a round body that a mesh is too coarse for, as a compliance of the contact points.

Under a contact of radius a a solid sinks in by about p a / E* more than the displacements of elements of size h can
show, where a is not far larger than h. Without it a press of 0.5 mm by a ball of 20 mm is 30 to 70 % too stiff on
elements of 10 mm, and the error depends on where in an element it touches. The part that is missing is local, so that
a compliance in series with the penalty restores it:

    u_local = c p,   c = C (1 - nu^2) h^2 / (a E) / (1 + RESOLVED (a / h)^3),   c E / h <= MOST

C is fitted once, to the compliance that a mesh of S1's block lacks against a fine one, see
`benchmarks/shallow.py`; with h -> 0 the compliance vanishes as the error of quadratic elements does. a is the contact
radius of the rigid geometry, (area of the rest surface inside the body / 2 pi)^(1/2), which is (R d)^(1/2) for a ball
of radius R at a depth d (Hertz). It depends on the pose alone, so that a frame has a potential and unloading retraces
loading. Past `SATURATED` of an element the contact is as stiff as elsewhere: there the mesh resolves it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.patch import PENALTY, WEIGHTS, Patch, smooth_radius
from vsfsim.physics.contact.reach import Reach
from vsfsim.physics.model import Model

FITTED = 0.044
"""C: the compliance times a E / ((1 - nu^2) h^2) where a is much smaller than h [-]."""
RESOLVED = 0.42
"""How fast the compliance falls where elements of size h resolve the contact radius a [-]: by 30 % at a = h. With 0,
the forces of S1 and S2 at 5 mm are too small by 0.8 and 2.1 %."""
MOST = 0.12
"""Largest compliance times E / h [-]: a load on a spot much smaller than an element sinks in by p a / E* alone."""
SATURATED = 0.022
"""Local indentation, over the element size, that is not exceeded [-]."""

_SMALL = 0.1  # the same over the radius of the smallest round body


def poisson_ratio(model: Model) -> float | None:
    """Poisson's ratio of a body of quadratic tetrahedra at small strain, its mean [-]; None for other elements."""
    for block in model.blocks:
        p = block.parameters
        if block.kind.startswith("tet10") and "mu" in p and "lam" in p:
            lam = float((p["lam"] + np.asarray(p.get("mean_lam", np.zeros(len(block))))[:, None]).mean())
            return lam / (2.0 * (lam + float(p["mu"].mean())))
    return None


class LocalIndentation:
    """The compliance of the contact points of B touches.

    Args:
        model: the object.
        patches: the patch of each touch (B); padded to f parts.
        area: of the boundary triangles [m^2].
        reach: distances to the rigid bodies (K).
        points: contact points at rest (B, 6 f, 3) [m].
        on: whether there is any such compliance.
    """

    def __init__(self, model: Model, patches: Sequence[Patch], area: np.ndarray, reach: Reach, points: torch.Tensor,
                 *, on: bool):
        nu, radii = poisson_ratio(model), [smooth_radius(s) for s in reach.bodies.shapes]
        self._round = [0.0 < r < np.inf for r in radii]
        self._on = on and nu is not None and any(self._round)
        self._reach, self._factor = reach, FITTED * (1.0 - (nu or 0.0) ** 2)
        self._points = points.transpose(0, 1).contiguous()
        cover, edge = np.zeros((len(patches), points.shape[1] // 6, 6)), np.zeros((len(patches), points.shape[1] // 6))
        for b, p in enumerate(patches):
            own, parts = area[p.faces], p.cuts**2
            cover[b, :len(p.part)] = np.repeat(own / parts, parts)[:, None] * WEIGHTS
            edge[b, :len(p.part)] = np.repeat(np.sqrt(2.0 * own), parts)
        self._cover = torch.as_tensor(cover, device=points.device).flatten(1)  # area of each point
        self._edge = torch.as_tensor(edge, device=points.device)
        self._share = torch.ones(cover.shape, dtype=torch.float64, device=points.device)
        soft = np.minimum(SATURATED * edge, _SMALL * min((r for r in radii if 0.0 < r < np.inf), default=0.0))
        self._soft = torch.as_tensor(soft, device=points.device)
        self._own: tuple[tuple[torch.Tensor, ...], torch.Tensor] | None = None
        self.arrays = (wp.from_torch(self._share), wp.from_torch(self._soft))

    def set_parts(self, at: tuple[np.ndarray, np.ndarray], share: np.ndarray, soft: np.ndarray) -> None:
        """Give some parts, ``at`` (touches, parts), a law of their own: the ``share`` of their stiffness (n,) [-] that
        acts down to the depth ``soft`` (n,) [m], see `body_points`."""
        where = tuple(torch.as_tensor(a, device=self._share.device) for a in at)
        self._own = where, torch.as_tensor(share, device=self._share.device)[:, None]
        self._share[where] = self._own[1]
        self._soft[where] = torch.as_tensor(soft, device=self._share.device)

    def move(self, pose: np.ndarray) -> None:
        """Set the compliance for the bodies at poses (B, K, 4, 4)."""
        if not self._on:
            return
        least, radius = torch.full_like(self._cover.T, torch.inf), torch.full_like(self._cover.T, torch.inf)
        for k, is_round in enumerate(self._round):
            gap = self._reach.nearest(pose[None], self._points, body=k)
            inside = (self._cover.T * (gap < 0.0)).sum(dim=0)
            own = (inside / (2.0 * np.pi)).sqrt() if is_round else torch.full_like(inside, torch.inf)
            radius = torch.where(gap < least, own, radius)
            least = torch.minimum(gap, least)
        # c E / h; a padded face has no edge and no stiffness
        radius = radius.T.reshape(self._share.shape).clamp(min=1e-12)
        wide = radius / self._edge[:, :, None].clamp(min=1e-12)
        compliance = (self._factor / wide / (1.0 + RESOLVED * wide**3)).clamp(max=MOST)
        # w_q = PENALTY E area / (h / sqrt(2)), in series with area / c
        self._share.copy_(1.0 / (1.0 + np.sqrt(2.0) * PENALTY * compliance))
        if self._own is not None:
            self._share[self._own[0]] = self._own[1]

    def energy(self, gap: torch.Tensor, stiffness: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Elastic energy of the local indentation of the touches ``columns`` (k,) [J], from the gaps (k, 6 f) [m] and
        the stiffness without it (k, f, 6) [N/m] of their points.

        In a press the compliance falls as d^(-1/2) while the energy at fixed compliance rises as d^(3/2), so that 2/3
        of the latter is the work that was done on it. Parts with a law of their own are not counted.
        """
        share, soft = self._share[columns], self._soft[columns][:, :, None]
        depth = torch.minimum((-gap).clamp(min=0.0).view_as(share), soft)
        force = share * stiffness * depth
        round_ = (self._edge[columns] > 0.0)[:, :, None]
        return 2.0 / 3.0 * (0.5 * force * depth * (1.0 - share) * round_).flatten(1).sum(dim=1)

    def resolution(self, touching: torch.Tensor, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How well the contact of the touches ``columns`` (k,) is resolved, from the points that touch (k, 6 f) bool:
        their number (k,), and the radius of a circle of their area over the edge of the elements there (k,) [-]."""
        area = self._cover[columns] * touching
        whole = area.sum(dim=1)
        edge = (area.view(*area.shape[:1], -1, 6).sum(dim=2) * self._edge[columns]).sum(dim=1)
        # edge is the sum of area x edge: sqrt(A / pi) / (edge / A)
        return touching.sum(dim=1), whole.sqrt() * whole / (np.sqrt(np.pi) * edge.clamp(min=1e-300))
