"""The noise of an arm's joint torques: white noise, an offset a touch, a random walk, an error of the arm's gravity
model that varies with posture, and hysteresis of the drives, minus the tare.

The gravity model's error is one random function of the joint angles for every joint, a Gaussian process with a squared
exponential covariance (by 256 random Fourier features), the same in all touches, as that of one real arm. It does not
depend on joint 1, whose axis is vertical. The hysteresis adds or subtracts a constant for each joint by the sign of its
velocity; a joint that stands still keeps its last sign, and that before a touch is random.
"""

from __future__ import annotations

import functools

import numpy as np

from vsfsim.bench.noise import Noise, stream, tared

_TORQUE, _ARM, _SIGN = 4, 6, 7  # channels of the random streams, after those of `noise_bubble`
_LARGE = 4  # joints 1 to 4 have the large actuators
_SMALL_SCALE = 0.5  # noise of the other joints relative to theirs, as their range
_POSE_SHARE = (0.375, 1.0, 0.375, 1.0, 0.25, 1.0, 0.25)  # of `Noise.torque_pose_std` at joints 1 to 7
_FEATURES = 256  # random Fourier features of the gravity model's error
_ARM_SPREAD = 0.25  # an arm's own error lies within this share of the mean over arms, a third more for the hysteresis
_STILL = 1e-5  # a joint that turns less between two frames stands still [rad]


def noisy_torque(torque: np.ndarray, time: np.ndarray, force: np.ndarray, noise: Noise, *, object_index: int,
                 view_index: int, touch_index: int, q: np.ndarray | None = None) -> np.ndarray:
    """The noise-free torques of a touch as real sensors would show them.

    Args:
        torque: noise-free (T, J) [N m]; NaN rows (unconverged frames) stay NaN.
        time: of the frames (T,) [s].
        force: noise-free contact force (T, 3) [N], which determines the contact-free frames of the tare.
        noise: its parameters.
        object_index, view_index, touch_index: of the touch; they select the random stream.
        q: joint angles (T, J) [rad]; without them there is neither an error in posture nor hysteresis.

    Returns:
        (T, J) [N m].
    """
    rng = stream(noise, object_index, view_index, touch_index, _TORQUE)
    joints = torque.shape[1]
    size = np.where(np.arange(joints) < _LARGE, 1.0, _SMALL_SCALE)
    offset = noise.torque_offset_std * rng.standard_normal(joints)
    steps = np.sqrt(np.diff(time, prepend=time[:1]))[:, None] * rng.standard_normal(torque.shape)
    white = noise.torque_std * rng.standard_normal(torque.shape)
    reading = torque + size * (offset + noise.torque_drift_std * np.cumsum(steps, axis=0) + white)
    if q is not None and (noise.torque_pose_std or noise.torque_hysteresis):
        start = stream(noise, object_index, view_index, touch_index, _SIGN).choice([-1.0, 1.0], joints)
        reading = reading + posture_error(q, noise) + size * hysteresis(q, start, noise)
    return tared(reading, force, noise)


def posture_error(q: np.ndarray, noise: Noise) -> np.ndarray:
    """Error of the gravity model [N m] at joint angles ``q`` (T, 7) [rad]: (T, 7), the same function of ``q`` in every
    touch."""
    share, slope, phase = _gravity_model(noise.seed, noise.torque_pose_length, q.shape[1])
    waves = np.cos(np.einsum("jfk,tk->tjf", slope, q) + phase)
    return noise.torque_pose_std * share * np.sqrt(2.0 / _FEATURES) * waves.sum(axis=2)


@functools.lru_cache(maxsize=8)
def _gravity_model(seed: int, length: float, joints: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of each joint (J,), and slopes (J, F, J) [1/rad] and phases (J, F) [rad] of the Fourier features; kept,
    because a data set asks for those of one arm in each of its thousands of touches."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_ARM,)))
    share = np.resize(_POSE_SHARE, joints) * rng.uniform(1.0 - _ARM_SPREAD, 1.0 + _ARM_SPREAD, joints)
    slope = rng.standard_normal((joints, _FEATURES, joints)) / length
    slope[:, :, 0] = 0.0
    return share, slope, rng.uniform(0.0, 2.0 * np.pi, (joints, _FEATURES))


def hysteresis(q: np.ndarray, start: np.ndarray, noise: Noise) -> np.ndarray:
    """Hysteresis of the drives [N m], of joints 1 to 4 in full size, along joint angles ``q`` (T, 7) [rad]: (T, 7).

    Args:
        q: joint angles.
        start: sign of each joint's last motion before the touch (7,).
        noise: its parameters.
    """
    rng = np.random.default_rng(np.random.SeedSequence(noise.seed, spawn_key=(_ARM, 1)))
    spread = 4.0 / 3.0 * _ARM_SPREAD
    height = noise.torque_hysteresis * rng.uniform(1.0 - spread, 1.0 + spread, q.shape[1])
    step = np.diff(q, axis=0, prepend=q[:1])
    sign = np.where(np.abs(step) > _STILL, np.sign(step), 0.0)
    sign[0] = start
    moved = np.maximum.accumulate(np.where(sign != 0.0, np.arange(len(q))[:, None], 0), axis=0)
    return height * np.take_along_axis(sign, moved, axis=0)
