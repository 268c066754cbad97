"""Joint angles that put the tool where it shall be: damped least squares on MuJoCo's Jacobian, inside the joint limits.

Levenberg's damping (Wampler 1986; Nakamura and Hanafusa 1986) carries the search past singular postures; a joint that
stands at its limit and would go on is left out of the step. With seven joints for six equations the step is the
shortest one, so that a tool that moves a little moves the joints a little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vsfsim.core.rotation import rotation_vector
from vsfsim.robot.arm import Arm

LEVER = 0.3  # m: a turn by 1 rad counts as much as this way; about the length of the last three links
# m, rad: when to stop; a hundred times finer than what a touch promises, and far above rounding
POSITION, ANGLE = 1e-7, 1e-6
STEP = 0.3  # rad, the longest a joint turns in an iteration
NEAR = 1e-9  # rad: a step that ends further inside than this meets no limit on its way, whatever rounding does
_EYE = np.eye(6)


@dataclass(frozen=True)
class Solution:
    """What the search ended with.

    q: joint angles (7,) [rad]. position: distance from the wanted position [m]. angle: from the wanted orientation
    [rad].
    at_limit: whether a joint stands at its limit. found: whether both are within the tolerances.
    """

    q: np.ndarray
    position: float
    angle: float
    at_limit: bool

    @property
    def found(self) -> bool:
        return self.position <= POSITION and self.angle <= ANGLE


def solve(arm: Arm, target: np.ndarray, start: np.ndarray, *, iterations: int = 100) -> Solution:
    """Joint angles near ``start`` (7,) [rad] that bring the tool to the pose ``target`` (4, 4) [m].

    Returns:
        The best point met; look at ``found``.
    """
    q = np.clip(start, arm.lower, arm.upper)
    error, jacobian = _error(arm, target, q)
    damping = 1e-4
    for _ in range(iterations):
        if _small(error):
            break
        step, free = _step(arm, q, error, jacobian, damping)
        trial = q + step
        if not ((trial > arm.lower + NEAR) & (trial < arm.upper - NEAR)).all():
            trial = _up_to_limits(arm, q, step, free)
        new_error, new_jacobian = _error(arm, target, trial)
        if new_error @ new_error < error @ error:
            q, error, jacobian, damping = trial, new_error, new_jacobian, max(damping * 0.2, 1e-12)
        elif damping > 1e3 or np.abs(step).max() < 1e-12:
            break  # a local minimum: the pose cannot be had from here
        else:
            damping *= 8.0
    at_limit = bool(((q <= arm.lower) | (q >= arm.upper)).any())
    return Solution(q, float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])) / LEVER, at_limit)


def _step(arm: Arm, q: np.ndarray, error: np.ndarray, jacobian: np.ndarray,
          damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The damped step (7,) [rad], no joint further than `STEP`, and which joints take part (7,)."""
    low, high = q <= arm.lower, q >= arm.upper
    free, j = np.ones(q.shape, bool), jacobian
    for _ in range(len(q)):
        step = j.T @ np.linalg.solve(j @ j.T + damping * _EYE, error)
        # a joint at its limit is free again as soon as the step leads back
        stuck = free & ((low & (step < 0.0)) | (high & (step > 0.0)))
        if not stuck.any():
            break
        free &= ~stuck
        j = jacobian * free
    return step * min(1.0, STEP / max(float(np.abs(step).max()), 1e-12)), free


def _up_to_limits(arm: Arm, q: np.ndarray, step: np.ndarray, free: np.ndarray) -> np.ndarray:
    """``q`` after the step, up to the first limit on the way; there that joint leaves the step and the others go on."""
    room = np.where(step > 0.0, arm.upper - q, arm.lower - q)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(free & (step != 0.0), room / step, np.inf)
    short = min(1.0, float(share.min()))
    trial = q + short * step
    # exactly at its limit, not a rounding away from it
    met = share <= short
    return np.where(met & (step > 0.0), arm.upper, np.where(met & (step < 0.0), arm.lower,
                                                            trial)) if short < 1.0 else trial


def _error(arm: Arm, target: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pose, jacobian = arm.tool_jacobian(q)
    jacobian[3:] *= LEVER
    out = np.empty(6)
    out[:3] = target[:3, 3] - pose[:3, 3]
    out[3:] = LEVER * rotation_vector(target[:3, :3] @ pose[:3, :3].T)
    return out, jacobian


def _small(error: np.ndarray) -> bool:
    # what np.linalg.norm does, without its overhead
    return math.sqrt(error[:3].dot(error[:3])) <= POSITION and math.sqrt(error[3:].dot(error[3:])) <= LEVER * ANGLE
