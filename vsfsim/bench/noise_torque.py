"""The noise of an arm's joint torques: white noise, an offset a touch and a random walk, minus the tare."""

from __future__ import annotations

import numpy as np

from vsfsim.bench.noise import Noise, stream, tared

_TORQUE = 4  # channel of the random streams, after those of `noise_bubble`
_LARGE = 4  # joints 1 to 4 have the large actuators
_SMALL_SCALE = 0.5  # noise of the other joints relative to theirs, as their range


def noisy_torque(torque: np.ndarray, time: np.ndarray, force: np.ndarray, noise: Noise, *, object_index: int,
                 view_index: int, touch_index: int) -> np.ndarray:
    """The noise-free torques of a touch as real sensors would show them.

    Args:
        torque: noise-free (T, J) [N m]; NaN rows (unconverged frames) stay NaN.
        time: of the frames (T,) [s].
        force: noise-free contact force (T, 3) [N], which determines the contact-free frames of the tare.
        noise: its parameters.
        object_index, view_index, touch_index: of the touch; they select the random stream.

    Returns:
        (T, J) [N m].
    """
    rng = stream(noise, object_index, view_index, touch_index, _TORQUE)
    joints = torque.shape[1]
    size = np.where(np.arange(joints) < _LARGE, 1.0, _SMALL_SCALE)
    offset = noise.torque_offset_std * rng.standard_normal(joints)
    steps = np.sqrt(np.diff(time, prepend=time[:1]))[:, None] * rng.standard_normal(torque.shape)
    white = noise.torque_std * rng.standard_normal(torque.shape)
    return tared(torque + size * (offset + noise.torque_drift_std * np.cumsum(steps, axis=0) + white), force, noise)
