"""The line integrals of the continuous VSF: forces on a sensor's vertices, linear in the stiffness at known points
(Neural VSF eq. 5).

    f(t) = sum_i K(p_i) c_i,   p_i = v(tau_i),   c_i = -(v(t) - v(tau_i)) s(tau_i) . dv(tau_i)

with v the path of a vertex and s its oriented area. The papers' observations are one for each touch, frame and vertex;
those of the pressure-only baseline one for each touch and frame: the sum over all vertices along an axis, which a rigid
probe's surface and force sensor give as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.core.errors import VsfError
from vsfsim.physics.mesh.structured import disc


@dataclass(frozen=True)
class SurfaceTouch:
    """One touch of a surface."""

    vertices: np.ndarray
    """World positions of its vertices (T, N, 3) [m]."""
    triangles: np.ndarray
    """Corners, wound outwards (m, 3)."""
    force: np.ndarray
    """Force of the object on each vertex, world (T, N, 3) [N], or on all of them against ``axis`` (T,) [N]; NaN in
    frames without a reading."""
    axis: np.ndarray | None = None
    """Unit vector (3,) [-] against which only the total force is known, or None."""


def dome(*, radius: float = 0.03, height: float = 0.015, rings: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A cap of a ball, apex down at the origin: vertices (N, 3) [m] and triangles (m, 3) wound outwards (down).

    Args:
        radius: of its rim [m].
        height: of the rim over the apex [m].
        rings: of vertices; N = 1 + 3 rings (rings + 1).
    """
    ball = (radius**2 + height**2) / (2.0 * height)
    flat, triangles = disc(radius, rings)
    ring = np.repeat(np.arange(rings + 1), [1, *(6 * np.arange(1, rings + 1))])
    above = ball - np.sqrt(ball**2 - (radius * ring / rings) ** 2)
    return np.column_stack([flat, above]), np.ascontiguousarray(triangles[:, ::-1])


def oriented_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area vectors of the triangles around each vertex (..., N, 3) [m^2] (Neural VSF section III-D)."""
    a, b, c = (vertices[..., triangles[:, k], :] for k in range(3))
    area = np.cross(b - a, c - a) / 6.0
    out = np.zeros_like(vertices)
    flat, given = out.reshape(-1, *vertices.shape[-2:]), area.reshape(-1, *area.shape[-2:])
    for frame, part in zip(flat, given):
        for k in range(3):
            np.add.at(frame, triangles[:, k], part)
    return out


@dataclass(frozen=True)
class _Paths:
    """Touches side by side, the shorter ones padded with their last frame."""

    place: torch.Tensor
    """Positions of the vertices (K, T, N, 3) [m]."""
    area: torch.Tensor
    """Their oriented areas (K, T, N, 3) [m^2]."""

    @classmethod
    def of(cls, touches: Sequence[SurfaceTouch], device: str) -> _Paths:
        if len({t.vertices.shape[1] for t in touches}) != 1:
            raise VsfError("vsf.line_integrals: the touches have surfaces of different numbers of vertices; they must "
                           "be of one sensor.")
        longest = max(len(t.vertices) for t in touches)

        def joined(parts: list[np.ndarray]) -> torch.Tensor:
            return torch.as_tensor(np.stack([np.concatenate([x, np.repeat(x[-1:], longest - len(x), axis=0)])
                                             for x in parts]), dtype=torch.float32, device=device)

        return cls(joined([t.vertices for t in touches]),
                   joined([oriented_areas(t.vertices, t.triangles) for t in touches]))

    def pieces(self, touch: torch.Tensor, frame: torch.Tensor, vertex: torch.Tensor,
               samples: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Midpoints p (b, S, 3) [m] and factors c (b, S, 3) [m^4] of the paths from frame 0 to ``frame``, in S pieces
        of equal time."""
        grid = torch.linspace(0.0, 1.0, samples + 1, device=self.place.device)
        ends = _along(self.place, touch, frame[:, None] * grid, vertex)
        points = 0.5 * (ends[:, 1:] + ends[:, :-1])
        middle = _along(self.area, touch, frame[:, None] * (0.5 * (grid[1:] + grid[:-1])), vertex)
        volume = (middle * (ends[:, 1:] - ends[:, :-1])).sum(dim=2)
        return points, -(ends[:, -1:] - points) * volume[..., None]


@dataclass(frozen=True)
class Forces:
    """Forces in some touches, all on the vertices or all in total."""

    paths: _Paths
    """Of all touches."""
    index: torch.Tensor
    """Touch, frame and vertex of every observation (M, 3); of a total, vertex 0."""
    force: torch.Tensor
    """(M, 3) [N], or totals (M, 1) [N]."""
    axis: torch.Tensor | None
    """Axis of the total of each touch (K, 3), or None."""

    @classmethod
    def of(cls, touches: Sequence[SurfaceTouch], *, device: str = "cpu") -> Forces:
        """From touches, without frame 0, where a path has no length, and without frames that have no reading.

        Raises:
            VsfError: no touch, fewer than two frames, or values that are not finite.
        """
        if not touches:
            raise VsfError("vsf.neural: there is no touch with contact forces on a surface.")
        total = touches[0].axis is not None
        index, force = [], []
        for k, touch in enumerate(touches):
            given, shape = np.asarray(touch.force), touch.vertices.shape
            known = ~np.isnan(given.reshape(len(given), -1)).all(axis=1)
            if (given.shape != (shape[:1] if total else shape) or len(given) < 2 or not known[1:].any()
                    or not (np.isfinite(touch.vertices).all() and np.isfinite(given[known]).all())):
                raise VsfError(f"vsf.neural: touch {k} has vertices {shape} and forces {given.shape}; both must be "
                               f"finite and (T, N, 3) with T of at least 2, or the forces totals (T,).")
            count = 1 if total else shape[1]
            t, v = (x.ravel() for x in np.meshgrid(1 + np.flatnonzero(known[1:]), np.arange(count), indexing="ij"))
            index.append(np.stack([np.full(t.size, k), t, v], axis=1))
            force.append(given[t, None] if total else given[t, v])
        axis = np.array([touch.axis for touch in touches]) if total else None
        return cls(_Paths.of(touches, device), torch.as_tensor(np.concatenate(index), device=device),
                   torch.as_tensor(np.concatenate(force), dtype=torch.float32, device=device),
                   None if axis is None else torch.as_tensor(axis, dtype=torch.float32, device=device))

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, S, 3) [m], factors (b, S, 3) [m^4] and forces (b, 3) [N] of observations ``which`` (b,); f is the
        sum over S of K(point) factor. Of totals S is that of all vertices; factors and forces have one component."""
        touch, frame, vertex = self.index[which].T
        if self.axis is None:
            return *self.paths.pieces(touch, frame, vertex, samples), self.force[which]
        every = torch.arange(self.cost(), device=touch.device).repeat(len(touch))
        touch, frame = touch.repeat_interleave(self.cost()), frame.repeat_interleave(self.cost())
        points, factor = self.paths.pieces(touch, frame, every, samples)
        along = -(factor * self.axis[touch][:, None]).sum(dim=2)
        return points.reshape(len(which), -1, 3), along.reshape(len(which), -1, 1), self.force[which]

    def cost(self) -> int:
        """Samples of one observation, in units of ``samples``."""
        return 1 if self.axis is None else int(self.paths.place.shape[2])


def _along(values: torch.Tensor, touch: torch.Tensor, time: torch.Tensor, vertex: torch.Tensor) -> torch.Tensor:
    """Values (K, T, N, 3) of vertices (b,) of touches (b,) at fractional frames (b, S): (b, S, 3)."""
    low = time.floor().long().clamp(0, values.shape[1] - 2)
    part = (time - low)[..., None]
    touch, vertex = touch[:, None], vertex[:, None]
    return (1.0 - part) * values[touch, low, vertex] + part * values[touch, low + 1, vertex]
