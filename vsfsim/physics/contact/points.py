"""Contact points of a batch of touches, with rigid bodies or with a soft sensor, and how they act on the nodes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from vsfsim.physics.contact.mount import Springs
from vsfsim.physics.contact.patch import at_points, nodal_sums
from vsfsim.physics.contact.stiffness import ContactStiffness, assembled

_ITERATION = "residual", "anchorings", "renewals"  # of friction in a step


class Contact:
    """The contact points of B touches on the degrees of freedom of their patches, padded to s nodes.

    Subclasses say which points there are: `faces`, `own_stiffness` and `_launch`.
    """

    device: str
    kernels: Any
    """The kernels of these points."""
    _sets: list[dict[str, torch.Tensor]]  # the tensors of the points, of some or of all each, by their names there
    _memory = "anchor", "owner", "limit", "across"  # names of those that remember friction

    dof: torch.Tensor
    """Degrees of freedom of the patches (B, 3 s); -1 is padding."""
    mask: torch.Tensor
    """1 where `dof` is no padding (B, 3 s) [-]."""
    free: torch.Tensor
    """1 where a degree of freedom may move (B, 3 s) [-]."""
    rest: torch.Tensor
    """Places of the nodes at rest (B, 3 s) [m]."""
    response: Any
    """How the bodies respond at rest, `rest_factor.Response`."""
    has_friction: bool
    springs: Springs | None = None
    """Springs that carry the rigid bodies."""
    symmetric: bool
    """Whether the stiffness is symmetric."""
    solid: bool
    """Whether rigid bodies touch a solid."""
    batch: int
    faces: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
    """Nodes and shape values of the parts of some touches (k,), see `stiffness`."""
    own_stiffness: Callable[..., torch.Tensor]
    """Stiffness of the contact points of some touches (k, p, 3, 3) [N/m], of some with the geometric term, see
    `stiffness`."""
    turn: tuple[int, torch.Tensor] | None = None
    """See `stiffness.assembled`, of all touches."""
    _launch: Callable[[Any, torch.Tensor], None]  # runs a kernel over the points of some touches (k,)
    _overlap: torch.Tensor  # how deep bodies lie in one another by the geometry at the last `extend_patch` (B,) [m]
    _passage: Any  # that check; its ``tolerance`` is the depth above which a body counts as inside [m]

    def _take(self, listed: np.ndarray, free: np.ndarray, points: np.ndarray) -> None:
        """Set `dof`, `mask`, `free` and `rest` for the nodes ``listed`` (B, s), -1 for padding, of all nodes with their
        ``free`` (3 n,) and ``points`` (n, 3) [m]."""
        dof = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1).reshape(len(listed), -1)
        self.dof = torch.as_tensor(dof, device=self.device)
        self.mask = (self.dof >= 0).to(torch.float64)
        self.free, self.rest = (torch.as_tensor(values.ravel(), dtype=torch.float64, device=self.device)[
            self.dof.clamp(min=0)] * self.mask for values in (free, points))

    def _all(self, name: str, columns: torch.Tensor) -> torch.Tensor:
        return torch.cat([points[name][columns].flatten(1) for points in self._sets], dim=1)

    def _inside(self, columns: torch.Tensor) -> torch.Tensor:
        """Which points are inside a body (k, p) bool, after the last evaluation as all below."""
        return self._all("gap", columns) < 0.0

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of the contact (k,) [J]."""
        return self._all("energy", columns).sum(dim=1)

    def carried(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of springs that carry the bodies (k,) [J]; 0 without."""
        return torch.zeros_like(self._overlap[columns]) if self.springs is None else self.springs.energy(columns)

    def local_energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Elastic energy of the object that its elements do not show (k,) [J]."""
        return torch.zeros_like(self._overlap[columns])

    def reach(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        """Part of a ``move`` (k, 3 s) [m] of the patches after which the first contact point meets the inner body of
        a rigid body (k,) [-], 1 where none does: past the middle of a body a point would be pushed out on the far
        side."""
        return torch.ones_like(self._overlap[columns])

    def follow(self) -> bool:
        """Let the local indentation follow bodies that springs carry; whether anything has changed."""
        return False

    def wrong_side(self, columns: torch.Tensor) -> torch.Tensor:
        """Number of points beyond the middle of a body (k,); a solution has none."""
        return self._all("wrong_side", columns).sum(dim=1)

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        """Whether any point is inside a body (k,) bool."""
        return self._inside(columns).any(dim=1)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """Depth of the deepest point (k,) [m]: of the contact points, and between them at the last `extend_patch`."""
        return torch.maximum(-self._all("gap", columns).amin(dim=1), self._overlap[columns])

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        """Share of the points in contact that slip (k,) [-]; 0 without contact."""
        inside = self._inside(columns)  # a point that has left may still have a limit in this step
        return (self._all("slips", columns) * inside).sum(dim=1) / inside.sum(dim=1).clamp(min=1)

    def update_friction(self, columns: torch.Tensor) -> None:
        """Renew the friction limit and the tangent plane from the last evaluation."""
        if self.has_friction:
            for points in self._sets:
                points["renewals"][columns] += 1
            self._launch(self.kernels.update_friction, columns)

    def friction_residual(self, columns: torch.Tensor) -> torch.Tensor:
        """Sum of the differences of the friction limits from Coulomb's after `update_friction` (k,) [N]."""
        return self._all("residual", columns).sum(dim=1)

    def _begin_friction(self, columns: torch.Tensor) -> None:
        for points in self._sets:
            for name in _ITERATION:
                points[name][columns] = 0

    def end_step(self, columns: torch.Tensor) -> None:
        """End the step: slipping points drag their anchors along, points that left contact lose them."""
        if self.has_friction and len(columns):
            self._launch(self.kernels.end_step, columns)

    def friction_state(self) -> Any:
        """A copy of the anchors, limits and tangent planes, for `restore_friction`; empty without friction."""
        return [{name: points[name].clone() for name in self._memory} for points in self._sets * self.has_friction]

    def restore_friction(self, columns: torch.Tensor, state: Any) -> None:
        """Return to a friction state after a step that failed."""
        for points, kept in zip(self._sets, state, strict=False):
            for name, value in kept.items():
                points[name][columns] = value[columns]

    def gather(self, u: torch.Tensor, columns: torch.Tensor | None = None) -> torch.Tensor:
        """Displacements [m] or forces [N] of the patches (k, 3 s) of ``columns`` (k,), None for all, out of those of
        all nodes u (3 n, k)."""
        dof, mask = (self.dof, self.mask) if columns is None else (self.dof[columns], self.mask[columns])
        assert u.shape[1] == len(dof), "torch would take the first columns of u in place of these"
        return u.gather(0, dof.clamp(min=0).T).T * mask

    def intruded(self, columns: torch.Tensor, times: float = 1.0) -> torch.Tensor:
        """Whether a body lies inside another where no contact point feels it, deeper than some ``times`` the tolerance
        (k,) bool, by the geometry at the last `extend_patch`."""
        return self._overlap[columns] > times * self._passage.tolerance

    def places(self, columns: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Vectors at the nodes of the patches (k, s, 3) interpolated to the contact points (k, p, 3)."""
        return at_points(*self.faces(columns), x)

    def nodal_of(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Forces at the contact points (k, p, 3) [N] as forces on the nodes (k, 3 s) [N]."""
        return nodal_sums(*self.faces(columns), force, self.free.shape[1] // 3).flatten(1)

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor, *,
                  block: bool) -> tuple[ContactStiffness, ContactStiffness | None]:
        """Contact stiffness on the patches, in series with springs that carry the bodies; and for a ``block`` the one
        without any geometric term, in series with the compliance of the bodies at rest, too.

        ``geometric``: the touches whose stiffness has its geometric term (k,) bool; deep inside a body that term is
        large and wrong."""
        own, plain = self.assembled(columns, geometric)
        compliance = self.response.between(columns, plain.dof) if block else 0.0
        if self.springs is not None:
            springs = self.springs.compliance(columns, own.dof)
            own, compliance = own.in_series(springs), compliance + springs
        return own, plain.in_series(compliance) if block else None

    def assembled(self, columns: torch.Tensor, geometric: torch.Tensor) -> list[ContactStiffness]:
        """Those of bodies that do not give way, with the geometric term of some touches and without."""
        turn = self.turn and (self.turn[0], self.turn[1][columns])
        each = torch.stack([self.own_stiffness(columns, geometric), self.own_stiffness(columns)], dim=2)
        return assembled(*self.faces(columns), each, self.free[columns], whole=self.has_friction, turn=turn)
