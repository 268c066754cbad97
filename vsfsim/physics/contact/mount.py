"""A rigid probe that a spring along its press carries: the mount is where the plan says, the probe where the spring
lets it.

The probe gives way by w against the press, and the contact's force along the press is that of the spring, k w. Of every
state of the object one w is in balance, so that w is eliminated: the contact's potential is the least over w of
that of the bodies and k w^2 / 2, its forces are those at that w, and its stiffness is

    (C^-1 + e e^T / k)^-1,

e being the translation of all nodes along the press: the mount's compliance is in series with that of the body.

w is found by Newton's method with the slope of the contact points (`rigid_kernels`, ``settle``): the contact's force
grows with depth, and the faster the deeper. A probe that has lost contact goes in by its gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.kernels import bound
from vsfsim.physics.runtime import real, vec3

BALANCED = 1e-3
"""Difference between the contact's force and the spring's, over the force, at which a frame is in equilibrium [-]."""
TRIALS = 40
"""Places of the probe that are tried for one state of the object; two to four are usual."""
EXACT = 1e-7
"""Difference between the contact's force and the spring's, over the force, that ends the search [-]: what is left must
not show in differences of potentials."""
TOUCH = 1e-7
"""How far the probe goes in past its first contact [m]."""
_FOLLOWED = 2e-4  # change of w over w after which the local indentation is that of another place


@dataclass(frozen=True)
class Mount:
    """The springs of a batch of B touches."""

    stiffness: float
    """k [N/m]."""
    axis: np.ndarray
    """Unit directions of the presses (B, 3) [-]."""


@wp.struct
class Arrays:
    """The springs of B touches that carry K bodies; what changes is written in place."""

    stiffness: real
    axis: wp.array(dtype=vec3)
    origin: wp.array2d(dtype=vec3)  # origins of the bodies where their springs give way by nothing [m]
    give: wp.array(dtype=real)
    excess: wp.array(dtype=real)


class Springs:
    """How far the springs of a run have given way.

    Args:
        mount: the springs.
        bodies: how many bodies each carries.
        device: Warp device.
    """

    give: torch.Tensor
    """w of each touch (B,) [m]."""
    excess: torch.Tensor
    """Force of the contact over that of the spring at the last evaluation (B,) [N]."""
    origin: torch.Tensor
    """Where the bodies would be if the springs did not give way (B, K, 3) [m]; to be written to."""

    def __init__(self, mount: Mount, bodies: int, device: str):
        self.arrays, found = bound(Arrays, {"stiffness": mount.stiffness, "axis": np.asarray(mount.axis, float)},
                                   (len(mount.axis), bodies), device)
        self.stiffness, self.axis, self.give, self.excess, self.origin = mount.stiffness, *(
            found[name] for name in ("axis", "give", "excess", "origin"))
        self._seen = self.give.clone()  # where the bodies were when the local indentation was set

    def poses(self, plan: np.ndarray) -> np.ndarray:
        """Poses (B, K, 4, 4) of the bodies whose mounts are at ``plan`` (B, K, 4, 4)."""
        out = plan.copy()
        out[..., :3, 3] -= (self.give[:, None] * self.axis)[:, None].cpu().numpy()
        return out

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Of the springs of ``columns`` (k,): (k,) [J]."""
        return 0.5 * self.stiffness * self.give[columns] ** 2

    def compliance(self, columns: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
        """e e^T / k (j, m, m) [m/N] of the touches ``columns`` (j,) between degrees of freedom ``dof`` (j, m)."""
        e = self.axis[columns].gather(1, dof % 3)
        return e[:, :, None] * e[:, None, :] / self.stiffness

    def moved_on(self) -> bool:
        """Whether the bodies are elsewhere than where the local indentation was set."""
        return bool(((self.give - self._seen).abs() > _FOLLOWED * self.give.abs()).any())

    def seen(self) -> None:
        """The local indentation is set where the bodies are."""
        self._seen = self.give.clone()

    def unbalanced(self, force: torch.Tensor) -> torch.Tensor:
        """Which springs are out of balance (B,) bool, under forces on the object (B, 3) [N]."""
        return self.excess.abs() > BALANCED * (force * self.axis).sum(dim=1).abs()
