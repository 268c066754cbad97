"""A force sensor's noise, put on clean touches when a task loads them.

The reading of frame t of a touch is f(t) + b + r t / (T - 1) + w(t): an offset b and a drift r drawn once a touch, and
white noise w, each normal and independent in x, y, z. Then the touch is tared: the mean of its first contact-free
frames is taken off, as one does with a real sensor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Noise:
    """Parameters of the noise.

    force_std: white noise, per component [N]. offset_std: offset of a touch, per component [N].
    drift_std: change from the first to the last frame of a touch, per component [N].
    tare_frames: at most so many leading contact-free frames are averaged and taken off; 0 for no tare.
    seed: root of the streams, >= 0; each touch of each view of each object has its own.
    """

    force_std: float
    offset_std: float
    drift_std: float
    tare_frames: int
    seed: int


FREE_FORCE = 1e-6
"""A frame is contact-free if the clean force is under this [N]: round-off of the solver, far under any sensor."""


def noisy_force(force: np.ndarray, noise: Noise, *, object_index: int, view_index: int, touch_index: int) -> np.ndarray:
    """The clean force of a touch as a real sensor would have shown it.

    Args:
        force: clean contact force on the probe (T, 3) [N]; NaN rows (unconverged frames) stay NaN.
        noise: how much of it.
        object_index, view_index, touch_index: which touch; they choose the random stream.

    Returns:
        (T, 3) [N].
    """
    stream = np.random.SeedSequence(noise.seed, spawn_key=(object_index, view_index, touch_index))
    rng = np.random.default_rng(stream)
    frames = len(force)
    offset = noise.offset_std * rng.standard_normal(3)
    drift = noise.drift_std * rng.standard_normal(3)
    white = noise.force_std * rng.standard_normal((frames, 3))
    out = force + offset + drift * np.linspace(0.0, 1.0, frames)[:, None] + white
    free = np.linalg.norm(np.nan_to_num(force, nan=np.inf), axis=1) < FREE_FORCE
    leading = frames if free.all() else int(np.argmin(free))
    tare = min(leading, noise.tare_frames)
    return out - out[:tare].mean(axis=0) if tare else out
