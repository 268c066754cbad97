"""What the solver asks of a contact: `rigid_contact` (rigid bodies) and `pair.contact` (a soft sensor) answer it.

A batch has B touches, one column each. The *patch* of a touch is the surface nodes that it can reach; all patches are
padded to s nodes. ``columns`` (k,) are the touches that a call is about; its results have their order.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch


class Contact(Protocol):
    """State of the contact of B touches on one device."""

    device: str
    """Torch and Warp device."""
    batch: int
    """Number of touches B."""
    has_friction: bool
    """Whether any pair of surfaces has a friction coefficient above 0."""
    softening: torch.Tensor
    """Factor on the contact stiffness (B,) [-]: 1, but 0 while an object comes to rest under its weight."""
    dof: torch.Tensor
    """Degrees of freedom of the patches (B, 3 s); -1 is padding."""
    mask: torch.Tensor
    """1 where `dof` is no padding (B, 3 s) [-]."""
    free: torch.Tensor
    """1 where a degree of freedom may move (B, 3 s) [-]."""
    response: Any
    """Displacements of the whole body at rest under forces: ``solve(right)`` and ``patch(touches, force)``."""
    compliance: Any
    """Rest-state compliance of the patches [m/N]: a tensor (B, 3 s, 3 s), or a `pair.links.Compliance`."""

    follows_below: float
    """Measure after a renewal of the friction limits under which they follow the normal forces from the next one on,
    see `coulomb`: 0 for never."""
    coulomb: torch.Tensor
    """1 for touches whose friction limits are those of the normal forces at every evaluation (B,) [-]; 0 where they are
    those of the last `update_friction`."""
    solid: bool
    """Whether rigid bodies touch a solid: not a membrane, and not a soft sensor."""
    flat: bool
    """Whether no body is curved, so that contact has no geometric term."""
    potential_trusted_above: float
    """Measure under which a step is accepted for its residual alone, because rounding hides the potential [-]."""
    decrease: float
    """Sufficient-decrease factor of the residual for such a step [-]."""
    friction_updated_below: float
    """Measure at which the friction limit is renewed for the first time in a step [-]."""
    patience: int
    """Iterations in which the measure may fail to fall by a tenth before a touch is given up."""

    _overlap: torch.Tensor
    """How deep bodies lie in one another by the geometry at the last `extend_patch` (B,) [m]."""
    _passage: Any
    """That check; its ``tolerance`` is the depth above which a body counts as inside [m]."""

    @property
    def symmetric(self) -> bool:
        """Whether the contact stiffness is symmetric."""

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        """Begin a step at the poses ``before`` (B, K, 4, 4) and the displacements u (3 n, B) [m]: slip counts from
        here."""

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> None:
        """Move the bodies to ``pose`` (B, K, 4, 4); ``columns`` are about to be solved there."""

    def gather(self, u: torch.Tensor, columns: torch.Tensor | None = None) -> torch.Tensor:
        """Displacements [m] or forces [N] of the patches (k, 3 s) of ``columns`` (k,), None for all, out of those of
        all nodes u (3 n, k)."""
        dof, mask = (self.dof, self.mask) if columns is None else (self.dof[columns], self.mask[columns])
        return u.gather(0, dof.clamp(min=0).T).T * mask

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Find gaps, forces and stiffness at displacements (k, 3 s) [m] of the patches. The methods below report what
        the last evaluation found."""

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of the contact (k,) [J]."""

    def carried(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of springs that carry the bodies (k,) [J]; 0 without."""
        return torch.zeros(len(columns), dtype=torch.float64, device=self.device)

    def follow(self) -> bool:
        """Let what depends on where the bodies are follow those that springs carry; whether anything has changed."""
        return False

    def local_energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Elastic energy of the object that its elements do not show (k,) [J], see `local_indentation`."""
        return torch.zeros(len(columns), dtype=torch.float64, device=self.device)

    def wrong_side(self, columns: torch.Tensor) -> torch.Tensor:
        """Number of points beyond the middle of the other body (k,); a solution has none."""

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces on the nodes of the patches (k, 3 s) [N]."""

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Force on every touching body (k, K, 3) [N], world."""

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Moment on every touching body about its origin (k, K, 3) [N m], world."""

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        """Whether any point is inside the other body (k,) bool."""

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """Depth of the deepest point (k,) [m]."""

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        """Share of the points in contact that slip (k,) [-]; 0 without contact."""

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Number of points in contact (k,), the radius of a circle of their area over the element size there (k,) [-],
        and the same of the contact with each body (k, K) [-]."""

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> Any:
        """Contact stiffness on the patches (k, 3 s, 3 s) [N/m], a tensor or an operator.

        ``geometric``: the touches whose stiffness has its geometric term (k,) bool; deep inside a body that term is
        large and wrong."""

    def block(self, columns: torch.Tensor) -> Any:
        """The contact stiffness, ready to be inverted together with the compliance of the bodies at rest."""

    def reach(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        """Part of a ``move`` (k, 3 s) [m] of the patches after which the first contact point meets the inner body of
        a rigid body (k,) [-], 1 where none does: past the middle of a body a point would be pushed out on the far
        side."""
        return torch.ones(len(columns), dtype=torch.float64, device=self.device)

    def update_friction(self, columns: torch.Tensor) -> None:
        """Renew the friction limit and the tangent plane from the last evaluation."""

    def friction_residual(self, columns: torch.Tensor) -> torch.Tensor:
        """Sum of the differences of the friction limits from Coulomb's after `update_friction` (k,) [N]."""

    def end_step(self, columns: torch.Tensor) -> None:
        """End the step: slipping points drag their anchors along, points that left contact lose them."""

    def friction_state(self) -> Any:
        """A copy of the anchors, limits and tangent planes, for `restore_friction`."""

    def restore_friction(self, columns: torch.Tensor, state: Any) -> None:
        """Return to a friction state after a step that failed."""

    def intruded(self, columns: torch.Tensor, times: float = 1.0) -> torch.Tensor:
        """Whether a body lies inside another where no contact point feels it, deeper than some ``times`` the tolerance
        (k,) bool, by the geometry at the last `extend_patch`."""
        return self._overlap[columns] > times * self._passage.tolerance

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, *,
                     touched: torch.Tensor | None = None) -> bool:
        """Extend the patches by surface that came into contact outside them at u (3 n, B), and by contact points where
        bodies were found between those; whether they had to.

        ``touched``: which touches were in contact when the step began (B,) bool. If one of them has lost a body, no
        points are added, because it jumped: a shorter step has to follow it."""
