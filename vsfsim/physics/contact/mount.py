"""A rigid probe that a spring along its press carries: the mount is where the plan says, the probe where the spring
lets it.

The probe gives way by w against the press, and the contact's force along the press is that of the spring, k w. Of every
state of the object one w is in balance, so that w is eliminated: the contact's potential is the least over w of
that of the bodies and k w^2 / 2, its forces are those at that w, and its stiffness is

    (C^-1 + e e^T / k)^-1,

e being the translation of all nodes along the press: the mount's compliance is in series with that of the body.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

BALANCED = 1e-3
"""Difference between the contact's force and the spring's, over the force, at which a frame is in equilibrium [-]."""
TRIALS = 40
"""Places of the probe that are tried for one state of the object; two to four are usual."""
# difference between the contact's force and the spring's, over the force, that ends the search: what is left must not
# show in differences of potentials
_EXACT = 1e-7
_FAR = 0.5  # of it over the spring's force: from here on the force goes with the square of the depth
_TOUCH = 1e-7  # how far the probe goes in past its first contact [m]
_FOLLOWED = 2e-4  # change of w over w after which the local indentation is that of another place


@dataclass(frozen=True)
class Mount:
    """The springs of a batch of B touches."""

    stiffness: float
    """k [N/m]."""
    axis: np.ndarray
    """Unit directions of the presses (B, 3) [-]."""


class Springs:
    """How far the springs of a run have given way.

    Args:
        mount: the springs.
        device: torch device.
    """

    give: torch.Tensor
    """w of each touch (B,) [m]."""
    excess: torch.Tensor
    """Force of the contact over that of the spring at the last evaluation (B,) [N]."""

    def __init__(self, mount: Mount, device: str):
        self.stiffness = mount.stiffness
        self.axis = torch.as_tensor(np.asarray(mount.axis, float), device=device)
        self.give, self.excess = (self.axis.new_zeros(len(self.axis)) for _ in range(2))
        self._seen = self.give.clone()  # where the bodies were when the local indentation was set

    def placed(self, origin: torch.Tensor) -> torch.Tensor:
        """Where bodies are (B, K, 3) [m] that their mounts carry to ``origin`` (B, K, 3) [m]."""
        return origin - (self.give[:, None] * self.axis)[:, None]

    def poses(self, plan: np.ndarray) -> np.ndarray:
        """The same of poses (B, K, 4, 4)."""
        out = plan.copy()
        out[..., :3, 3] = self.placed(torch.as_tensor(plan[..., :3, 3], device=self.axis.device)).cpu().numpy()
        return out

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Of the springs of ``columns`` (k,): (k,) [J]."""
        return 0.5 * self.stiffness * self.give[columns] ** 2

    def along(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Sum along the presses (k,) [N] of forces on the object (k, 3 n) [N]."""
        return (force.view(len(columns), -1, 3).sum(dim=1) * self.axis[columns]).sum(dim=1)

    def compliance(self, columns: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
        """e e^T / k (j, m, m) [m/N] of the touches ``columns`` (j,) between degrees of freedom ``dof`` (j, m)."""
        e = self.axis[columns].gather(1, dof % 3)
        return e[:, :, None] * e[:, None, :] / self.stiffness

    def settle(self, columns: torch.Tensor, look: Callable[[torch.Tensor], tuple[torch.Tensor, ...]]) -> None:
        """Bring the springs of the touches ``columns`` (k,) into balance.

        Newton's method in a bracket, with the slope of the contact points. Far from the root the force goes with the
        square of the depth, as under a ball; a probe that has lost contact goes in by its gap.

        Args:
            columns: see above.
            look: evaluates the contact of some touches (j,) where their springs let the bodies, and returns its forces
                [N] and stiffness [N/m] along the presses, and its least gaps [m], (j,) each.
        """
        low, high = torch.full_like(self.give, -torch.inf), torch.full_like(self.give, torch.inf)
        for trial in range(TRIALS):
            give, (pull, slope, gap) = self.give[columns], look(columns)
            spring = self.stiffness * give
            self.excess[columns] = excess = pull - spring
            off = excess.abs() > _EXACT * torch.maximum(pull.abs(), spring.abs())
            if trial == TRIALS - 1 or not bool(off.any()):
                return
            columns, give, pull, slope, gap, spring, excess = (
                t[off] for t in (columns, give, pull, slope, gap, spring, excess))
            low[columns] = torch.where(excess > 0.0, give, low[columns])
            high[columns] = torch.where(excess < 0.0, give, high[columns])
            far = (excess.abs() > _FAR * spring.abs()) & (pull > 0.0)
            both, square = slope + self.stiffness, torch.where(far, slope**2 / pull, 0.0)
            new = give + 2.0 * excess / (both + (both**2 - square * excess).clamp(min=0.0).sqrt())
            new = torch.where(gap >= 0.0, (give - gap - _TOUCH).clamp(min=0.0), new)
            middle = 0.5 * (low[columns] + high[columns])
            within = (new > low[columns]) & (new < high[columns])
            self.give[columns] = torch.where(within | ~middle.isfinite(), new, middle)

    def slope(self, own: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Stiffness along the presses of ``columns`` (k,) of points with the stiffness ``own`` (k, q, 3, 3): (k,)
        [N/m]."""
        axis = self.axis[columns][:, None, :, None]
        return (axis.mT @ own @ axis)[..., 0, 0].sum(dim=1)

    def moved_on(self) -> bool:
        """Whether the bodies are elsewhere than where the local indentation was set."""
        return bool(((self.give - self._seen).abs() > _FOLLOWED * self.give.abs()).any())

    def seen(self) -> None:
        """The local indentation is set where the bodies are."""
        self._seen = self.give.clone()

    def unbalanced(self, force: torch.Tensor) -> torch.Tensor:
        """Which springs are out of balance (B,) bool, under forces on the object (B, 3) [N]."""
        return self.excess.abs() > BALANCED * (force * self.axis).sum(dim=1).abs()
