"""A rigid probe that a spring along its press carries: the mount is where the plan says, the probe where the spring
lets it.

In each frame the probe gives way by w against the press, and the contact's force along the press F(w) is that of the
spring, F(w) = k w. F falls with w, so that one root is sought for each touch by Newton's method on w with the slope of
the last two equilibria (the secant method), held in a bracket. Every trial is an equilibrium of the object.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vsfsim.physics.solve.audit import Rows, mark
from vsfsim.physics.solve.frames import Reason

BALANCED = 1e-3
"""Difference between the contact's force and the spring's, over the force, at which a frame is in equilibrium [-]: the
tolerance of the tiers for a body's own balance. Where the contact is as stiff as the spring, the force of the frame
is then that of a mount 0.05 % of its travel away."""
TRIALS = 12
"""Equilibria of one frame that are tried before it is marked; three are usual."""
# slope of a first contact: that of a ball on a half-space over force / travel of its frame, which is mostly free, and
# at least this part of the spring's, so that the next trial does not lose contact
_FIRST, _LIKE = 1.5, 0.5


@dataclass
class Mount:
    """The springs of a batch of B touches, in the frames of one run."""

    stiffness: float
    """k [N/m]."""
    axis: np.ndarray
    """Unit directions of the presses (B, 3) [-]."""
    give: np.ndarray = field(init=False)
    """How far each probe has given way in the trial at hand, w (B,) [m]."""
    _slope: np.ndarray = field(init=False)  # -dF/dw (B,) [N/m]
    _spent: dict[str, np.ndarray] = field(init=False)  # iterations of the trials before
    _last: tuple[np.ndarray, np.ndarray] = field(init=False)  # travel and force of the frame before (B,) [m], [N]

    def __post_init__(self) -> None:
        self.give, self._slope = np.zeros(len(self.axis)), np.zeros(len(self.axis))
        self._last = np.full(len(self.axis), np.nan), np.zeros(len(self.axis))

    def begin(self, plan: np.ndarray) -> np.ndarray:
        """Poses (B, K, 4, 4) of the first trial of a frame whose mounts are at ``plan`` (B, K, 4, 4): with the force of
        the frame before, which grows with the slope that was met last."""
        self._plan, self._low, self._high = plan, np.zeros(len(self.axis)), np.full(len(self.axis), np.inf)
        travel = np.einsum("bi,bi->b", plan[:, 0, :3, 3], self.axis)
        probe, force = self._last
        ahead = np.nan_to_num(travel - probe)  # of the probe, if it gave way no further
        self._step, self._before = np.abs(ahead), travel - probe
        self.give = np.maximum((force + self._slope * ahead) / (self.stiffness + self._slope), 0.0)
        self._trials: list[tuple[np.ndarray, np.ndarray]] = []
        self._failed = np.zeros(len(self.axis), bool)
        return self._placed()

    def correct(self, out: Rows) -> np.ndarray | None:
        """Poses (B, K, 4, 4) of the next trial, or None where the springs balance, or `TRIALS` have been made.

        Args:
            out: of this trial. One without an equilibrium is tried once more, half as far. What is open after the last
                is marked.
        """
        force, converged = out["force"], out["converged"]
        self._spent = {key: out[key] for key in ("iterations", "cg_iterations")}
        along = np.where(converged, -np.einsum("bi,bi->b", np.nan_to_num(force), self.axis), np.nan)
        w, k = self.give, self.stiffness
        excess = along - k * w
        size = np.maximum(np.abs(along), k * w)
        open_ = converged & (np.abs(excess) > BALANCED * size)
        again = ~converged & ~self._failed & (self._before > w)
        self._failed |= ~converged
        if self._trials:
            moved = w - self._trials[-1][0]
            with np.errstate(divide="ignore", invalid="ignore"):
                met = -(along - self._trials[-1][1]) / moved
            self._slope = np.where(np.isfinite(met) & (met > 0.0), met, self._slope)
        else:  # the force since the frame before as a parabola whose slope there is known: its slope here
            known = self._last[1]
            chord = (along - known) / np.where(self._before > w, self._before - w, np.nan)
            bent = np.clip(2.0 * chord - self._slope, 0.5 * chord, 2.0 * chord)
            self._slope = np.where((known > 0.0) & (self._slope > 0.0) & (chord > 0.0), bent, self._slope)
        first = (self._slope <= 0.0) & (along > 0.0)
        least = np.maximum(_FIRST * along / np.maximum(self._step, 1e-9), _LIKE * k)
        self._slope = np.where(first, least, self._slope)
        self._low = np.where(open_ & (excess > 0.0), np.maximum(self._low, w), self._low)
        self._high = np.where(open_ & (excess < 0.0), np.minimum(self._high, w), self._high)
        self._trials.append((w.copy(), along))
        # no force without contact: the slope there says nothing, and the bracket halves what is between
        step = np.where(along > 0.0, w + excess / (k + self._slope), np.inf)
        middle = 0.5 * (self._low + np.where(np.isfinite(self._high), self._high, w))
        step = np.where((step > self._low) & (step < self._high), step, middle)
        if not (open_ | again).any() or len(self._trials) >= TRIALS:
            probe = np.einsum("bi,bi->b", self._plan[:, 0, :3, 3], self.axis) - w
            self._last = (np.where(converged, probe, self._last[0]),
                          np.where(converged, along, self._last[1]))
            self._slope = np.where(np.nan_to_num(along) > 0.0, self._slope, 0.0)
            mark(out, open_, Reason.MOUNT)
            return None
        self.give = np.where(open_, step, np.where(again, 0.5 * (w + self._before), w))
        return self._placed()

    def counted(self, out: Rows) -> Rows:
        """A trial with the iterations of those before it."""
        return out | {key: out[key] + before for key, before in self._spent.items()}

    def _placed(self) -> np.ndarray:
        out = self._plan.copy()
        out[..., :3, 3] -= (self.give[:, None] * self.axis)[:, None]
        return out
