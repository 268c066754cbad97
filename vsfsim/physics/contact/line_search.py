"""The line search of Newton's method on the condensed problem (`condensed`), one thread a touch: what each touch does
next is decided on the device."""

import functools
from typing import Any

import torch
import warp as wp

from vsfsim.physics.runtime import real

_FALLS = wp.constant(real(1e-4))  # share of the slope by which the energy of a step must fall (Armijo)
_ROUNDING = wp.constant(real(1e-12))  # of the energy: rounding of the sum over the patch
_SHORTEST, _BACK = wp.constant(real(1e-4)), wp.constant(real(0.1))  # step; its least length over the one before
CURVED = 0.01  # error from which on the stiffness has its geometric term
AGAIN = 0.1  # part of that after a failure
_AGAIN = wp.constant(real(AGAIN))
# rows of the tables of a search: numbers, flags and counts of each touch
_LEVEL, _SLOPE, _STEP, _ERROR, _MOST, _GO = (wp.constant(i) for i in range(6))
_RUNNING, _AHEAD, _BENDS, _BETTER, _CURVED = (wp.constant(i) for i in range(5))
_WRONG_SIDE, _IDLE = (wp.constant(i) for i in range(2))


@functools.cache
def kernel() -> Any:
    """The kernel of `LineSearch.judge`."""

    @wp.kernel(module="vsfsim_line_search", enable_backward=False)
    def judge(
        # state in
        energy: wp.array(dtype=real),
        wrong_side: wp.array(dtype=wp.int64),
        size: wp.array(dtype=real),
        tolerance: real,
        patience: wp.int64,
        # state out
        number: wp.array2d(dtype=real),
        flag: wp.array2d(dtype=wp.bool),
        count: wp.array2d(dtype=wp.int64),
    ):
        k = wp.tid()
        was, level, slope, step = flag[_RUNNING, k], number[_LEVEL, k], number[_SLOPE, k], number[_STEP, k]
        error, most = real(number[_ERROR, k]), real(number[_MOST, k])  # copies, which may change
        crosses = wrong_side[k] > count[_WRONG_SIDE, k]
        rises = energy[k] > level - _FALLS * step * slope + _ROUNDING * wp.abs(level)
        far = was and (crosses or rises) and step > _SHORTEST
        go = real(0.0)
        if far:
            # go back to the least energy of a parabola along this step, by half of it at least
            shorter = real(0.5) * step
            if not crosses:
                least = shorter * slope * step / wp.max(energy[k] - level + slope * step, real(1e-300))
                shorter = wp.clamp(least, _BACK * step, shorter)
            go = shorter - step
            number[_STEP, k] = shorter
            if flag[_CURVED, k] and error < most:
                most = _AGAIN * error
        better = was and not far and size[k] < error
        idle = wp.int64(count[_IDLE, k])
        if better:
            error = size[k]
            idle = wp.int64(0)
        elif not far:
            idle += wp.int64(1)
        running = was and (far or size[k] >= tolerance) and idle < patience
        ahead = running and not far
        if ahead:
            go = real(1.0)
            number[_LEVEL, k] = energy[k]
            number[_STEP, k] = real(1.0)
            count[_WRONG_SIDE, k] = wrong_side[k]
        number[_ERROR, k] = error
        number[_MOST, k] = most
        number[_GO, k] = go
        count[_IDLE, k] = idle
        flag[_RUNNING, k] = running
        flag[_AHEAD, k] = ahead
        flag[_BENDS, k] = ahead and error < most
        flag[_BETTER, k] = better

    return judge


class LineSearch:
    """The searches of ``count`` touches.

    Args:
        tolerance: error at which a touch is done.
        patience: iterations without a new least error after which it is given up.
    """

    def __init__(self, count: int, tolerance: float, patience: int, device: torch.device):
        self._limits = tolerance, patience
        self._number = torch.zeros((6, count), dtype=torch.float64, device=device)
        self._number[_LEVEL] = self._number[_ERROR] = float("inf")
        self._number[_STEP], self._number[_MOST] = 1.0, CURVED
        self._flag = torch.zeros((5, count), dtype=torch.bool, device=device)
        self._flag[_RUNNING] = True
        self._count = torch.zeros((2, count), dtype=torch.int64, device=device)
        self._count[_WRONG_SIDE] = torch.iinfo(torch.int64).max

    def judge(self, energy: torch.Tensor, wrong_side: torch.Tensor, size: torch.Tensor) -> tuple[int, int]:
        """Decide what touches with this ``energy`` (k,) [J], number of points on the wrong side of a body (k,) and
        error (k,) [-] do next. Returns how many go on, and how many of these take a new direction; the others go back
        along the last one."""
        wp.launch(kernel(), dim=len(energy), device=wp.device_from_torch(energy.device), inputs=[
            *(wp.from_torch(t) for t in (energy, wrong_side, size)), *self._limits,
            *(wp.from_torch(t) for t in (self._number, self._flag, self._count))])
        left, going = self._flag[:2].sum(dim=1).tolist()
        return left, going

    def turn(self, slope: torch.Tensor, curved: torch.Tensor, up: torch.Tensor) -> None:
        """Note the slopes (k,) [J] of the new directions, which of these have the geometric term (k,) bool, and for
        which it was left out again because it led ``up`` (k,) bool."""
        self._number[_SLOPE] = torch.where(self.ahead, slope, self._number[_SLOPE])
        self._flag[_CURVED] = torch.where(self.ahead, curved, self._flag[_CURVED])
        self._number[_MOST] = torch.where(up, AGAIN * self.error, self._number[_MOST])

    def keep(self) -> torch.Tensor:
        """Drop the touches that are done; which (j,) are left."""
        left = self._flag[_RUNNING].nonzero()[:, 0]
        self._number, self._flag, self._count = (t[:, left].contiguous()
                                                 for t in (self._number, self._flag, self._count))
        return left

    @property
    def error(self) -> torch.Tensor:
        """Least error so far (k,) [-]."""
        return self._number[_ERROR]

    @property
    def go(self) -> torch.Tensor:
        """Part of the direction to go along it, or back (k,) [-]."""
        return self._number[_GO]

    @property
    def ahead(self) -> torch.Tensor:
        """Who takes a new direction (k,) bool."""
        return self._flag[_AHEAD]

    @property
    def bends(self) -> torch.Tensor:
        """Whose direction is to have the geometric term of the contact (k,) bool."""
        return self._flag[_BENDS]

    @property
    def better(self) -> torch.Tensor:
        """Whose error is the least so far (k,) bool."""
        return self._flag[_BETTER]
