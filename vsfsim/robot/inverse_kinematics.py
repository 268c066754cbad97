"""Inverse kinematics: damped least squares on MuJoCo's Jacobian, within the joint limits and a margin.

Levenberg's damping (Wampler 1986; Nakamura and Hanafusa 1986) keeps the search stable near singular postures. A joint
at its limit that would move further is left out of the step. With seven joints for six equations the step is the one of
least norm, so that a small motion of the tool is a small motion of the joints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vsfsim.robot.arm import Arm

LEVER = 0.3  # the distance that counts as much as a rotation by 1 rad [m]; about the length of the last three links
# Tolerances [m], [rad]: a hundred times finer than those of a touch, and far above the rounding error.
POSITION, ANGLE = 1e-7, 1e-6
STEP = 0.3  # largest rotation of a joint in an iteration [rad]
NEAR = 1e-9  # a step that ends further than this from the limits has met none, also with rounding [rad]
_EYE = np.eye(6)


@dataclass(frozen=True)
class Solution:
    """The best joint angles of a search."""

    q: np.ndarray
    """Joint angles (7,) [rad]."""
    position: float
    """Distance of the tool from the target [m]."""
    angle: float
    """Angle of the tool from the target [rad]."""
    at_limit: bool
    """Whether a joint is as near to its limit as a path may lead it."""

    @property
    def found(self) -> bool:
        """Whether position and angle are within the tolerances."""
        return self.position <= POSITION and self.angle <= ANGLE


def solve(arm: Arm, target: np.ndarray, start: np.ndarray, *, iterations: int = 100) -> Solution:
    """Joint angles near ``start`` (7,) [rad] that bring the tool to the pose ``target`` (4, 4) [m].

    Returns:
        The best point of the search, whether or not it is a solution; see `Solution.found`.
    """
    q = np.clip(start, arm.least, arm.most)
    error, jacobian = _error(arm, target, q)
    damping = 1e-4
    for _ in range(iterations):
        if _small(error):
            break
        step, free = _step(arm, q, error, jacobian, damping)
        trial = q + step
        if not ((trial > arm.least + NEAR) & (trial < arm.most - NEAR)).all():
            trial = _up_to_limits(arm, q, step, free)
        new_error, new_jacobian = _error(arm, target, trial)
        if new_error @ new_error < error @ error:
            q, error, jacobian, damping = trial, new_error, new_jacobian, max(damping * 0.2, 1e-12)
        elif damping > 1e3 or np.abs(step).max() < 1e-12:
            break  # a local minimum: the target cannot be reached from here
        else:
            damping *= 8.0
    at_limit = bool(((q <= arm.least) | (q >= arm.most)).any())
    return Solution(q, float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:])) / LEVER, at_limit)


def _step(arm: Arm, q: np.ndarray, error: np.ndarray, jacobian: np.ndarray,
          damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The damped step (7,) [rad], with no joint further than `STEP`, and which joints take part (7,)."""
    low, high = q <= arm.least, q >= arm.most
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
    """``q`` after the step, shortened to the first joint limit on the way."""
    room = np.where(step > 0.0, arm.most - q, arm.least - q)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(free & (step != 0.0), room / step, np.inf)
    short = min(1.0, float(share.min()))
    trial = q + short * step
    if short < 1.0:
        met = share <= short  # these joints are set exactly to their limits
        trial = np.where(met & (step > 0.0), arm.most, np.where(met & (step < 0.0), arm.least, trial))
    return trial


def _error(arm: Arm, target: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position error [m] and rotation vector [rad] times `LEVER` from the tool to the target (6,), and the Jacobian of
    the tool in the same units (6, 7)."""
    pose, jacobian = arm.tool_jacobian(q)
    jacobian[3:] *= LEVER
    out = np.empty(6)
    out[:3] = target[:3, 3] - pose[:3, 3]
    out[3:] = LEVER * _rotation_vector(target[:3, :3] @ pose[:3, :3].T)
    return out, jacobian


def _rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """As `core.rotation.rotation_vector` of one matrix (3, 3), through the quaternion whose largest component comes
    first (Shepperd 1978).

    It is written out for two reasons. scipy's takes 330 us with its checks, this one 23 us, and a pose needs a hundred
    calls. And the touches of plants snap: joint angles that differ by 3e-12 rad, as with MuJoCo's or scipy's rounding,
    change single readings by 1.7 N m, so that data sets would not be made again to the same bits.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = matrix.tolist()
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    a, b, c = zy - yz, xz - zx, yx - xy
    d, e, f = yx + xy, xz + zx, zy + yz
    rows = ((squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3]))
    q = np.array(rows[squares.index(max(squares))])
    q /= math.sqrt(q.dot(q))
    if q[0] < 0.0:
        q = -q
    axis = q[1:]
    sine = math.sqrt(axis.dot(axis))
    if sine == 0.0:
        return np.zeros(3)
    return 2.0 * np.arctan2(sine, q[0]) * axis / sine


def _small(error: np.ndarray) -> bool:
    # np.linalg.norm without its overhead
    return math.sqrt(error[:3].dot(error[:3])) <= POSITION and math.sqrt(error[3:].dot(error[3:])) <= LEVER * ANGLE
