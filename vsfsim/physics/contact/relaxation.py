"""Relaxation of friction's limits: what keeps the sequence of Tresca problems from going to and fro, or on for ever.

Where friction lifts a point off and touch brings it back, the whole change of its limit would be made and unmade for
ever. So the part of a change that is made goes, point by point, by the secant of the last two changes (Aitken's
relaxation; Irons and Tuck 1969). What is held back counts as missing of Coulomb's law: a frame with any of it left is
not in balance. And a point that
came into touch in this step where the object bulged up is anchored where it is: an anchor that went along with its
point would creep on for ever, so it is set a few times and then stays.
"""

from typing import Any

import torch
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly

ANCHORINGS = 3  # times in a step that an anchor made in it may be set
_LEAST = 1.0 / 16.0  # part of a change that is made at the least


def function(real: type, module: str) -> Any:
    """``relaxed`` for one scalar type and kernel module: from the limit that Coulomb's law asks for, the present one,
    the damping and the last change -> the next limit, its damping, this change, and what is missing of it."""
    least = wp.constant(real(_LEAST))

    @wp.func(module=module)
    def relaxed(asked: real, present: real, damping: real, last: real):
        change = asked - present
        part = damping
        if (last - change) * last > real(0.0):
            part = wp.clamp(damping * last / (last - change), least, real(1.0))
        return present + part * change, part, change, (real(1.0) - part) * wp.abs(change)

    return relaxed


class Relaxation:
    """What friction's iteration of B touches remembers within a step. anchorings: how often an anchor was set; damping
    [-], change [N] and miss [N] of the limits: of every point, tensors of one shape (B, ...).

    Args:
        size: of the tensors. device: of them.
    """

    def __init__(self, size: tuple[int, ...], device: str):
        self.change, self.miss = (torch.zeros(size, dtype=torch.float64, device=device) for _ in range(2))
        self.damping = torch.ones(size, dtype=torch.float64, device=device)
        self.anchorings = torch.zeros(size, dtype=torch.int32, device=device)
        # once: the tensors are only ever written in place
        self._arrays = [wp.from_torch(t) for t in (self.anchorings, self.damping, self.change, self.miss)]

    def begin(self) -> None:
        """A step begins."""
        self.damping.fill_(1.0)
        for value in (self.anchorings, self.change, self.miss):
            value.zero_()

    def arrays(self) -> list[wp.array]:
        """anchorings, damping, change, miss, as Warp's arrays."""
        return self._arrays

    def unlawful(self, columns: torch.Tensor) -> torch.Tensor:
        """By how much the limits of the touches ``columns`` (k,) miss Coulomb's (k,) [N]."""
        return self.miss[columns].flatten(1).sum(dim=1)
