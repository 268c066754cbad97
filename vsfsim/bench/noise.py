"""A sensor's noise, added to noise-free touches when a task loads them.

Force: the reading of frame t of a touch is f(t - lag) + b + r t / (T - 1) + w(t): an offset b and a drift r drawn once
a touch, and white noise w, each normal and independent in x, y, z. Then the touch is tared: the mean of its first
contact-free frames is subtracted, as with a real sensor. The readings of an air-filled bubble are in
`vsfsim.bench.noise_bubble`, joint torques in `vsfsim.bench.noise_torque`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Noise:
    """Parameters of the sensors' noise; see the noise of each channel for what they do."""

    force_std: float
    """White noise of the force, per component [N]."""
    offset_std: float
    """Offset of the force in a touch, per component [N]."""
    drift_std: float
    """Change of the force's offset from the first to the last frame of a touch, per component [N]."""
    tare_frames: int
    """Greatest number of leading contact-free frames whose mean is subtracted; 0 for no tare."""
    seed: int
    """Root of the random streams, >= 0; each touch of each view of each object has its own."""
    force_lag: float = 0.0
    """Delay of the force relative to the pressure [s]."""
    pressure_std: float = 0.0
    """White noise of the pressure [Pa]."""
    pressure_drift: float = 0.0
    """Mean rate of the pressure's drift [Pa/s]."""
    pressure_drift_std: float = 0.0
    """Standard deviation of that rate over touches [Pa/s]."""
    relaxation: float = 0.0
    """Fraction of a change of pressure by which the sensor overshoots at first [-]."""
    relaxation_time: float = 0.15
    """Time constant with which the overshoot decays [s]."""
    depth_std: float = 0.0
    """White noise of a pixel's depth [m]."""
    depth_quantum: float = 0.0
    """Quantisation step of the depth [m]; 0 for none."""
    image_lag: float = 0.0
    """Delay of images, and of node positions made from them, relative to the pressure [s]."""
    tracking_std: float = 0.0
    """Drift of a node across its ray at the end of a touch, per component [m], as of a tracker that accumulates its
    errors from frame to frame; 0 at the first frame."""
    tracking_length: float = 0.010
    """Correlation length of that drift over the skin [m]."""
    window: float = 0.0
    """Part of the rim's semi-axes within which the inside camera sees nodes [-]; nodes outside are not shown. 0: all
    are."""
    node_force_share: float = 0.0
    """Error of an estimated contact force on a node, relative to the RMS force of the nodes in contact in that frame
    [-]."""
    torque_std: float = 0.0
    """White noise of the torque sensors of joints 1 to 4 [N m]; here and below, joints 5 to 7 have half as much."""
    torque_offset_std: float = 0.0
    """Offset of a torque in a touch [N m]."""
    torque_drift_std: float = 0.0
    """Random walk of a torque after one second [N m]."""
    torque_pose_std: float = 0.0
    """Standard deviation over postures of the error of the arm's gravity model at joints 2, 4 and 6, mean over arms
    [N m]; 0.375 of it at joints 1 and 3, 0.25 at 5 and 7."""
    torque_pose_length: float = 0.3
    """Correlation length of that error in joint angles [rad]."""
    torque_hysteresis: float = 0.0
    """Half of the drives' hysteresis, which changes its sign with a joint's velocity, mean over arms [N m]; of joints 5
    to 7 half as much."""


NOISE_KINDS: Mapping[str, Mapping[str, float]] = {
    "punyo": {
        # images lag the pressure by 77 ms and the wrench by 58 ms, so the wrench lags the pressure by 19 ms
        "force_std": 0.14, "force_lag": 0.019,
        "pressure_std": 5.4, "pressure_drift": -1.6,  # -8 Pa in 5 s
        "relaxation": 0.02, "relaxation_time": 0.15,
        "depth_std": 5e-5, "depth_quantum": 1e-4, "image_lag": 0.077,
        # of a good force estimator at this depth noise (`vsfsim measure dense-force`), not of the sensor
        "node_force_share": 0.2,
    },
    "punyo-window": {
        "force_std": 0.14, "force_lag": 0.019, "pressure_std": 5.4, "pressure_drift": -1.6,
        "relaxation": 0.02, "relaxation_time": 0.15, "depth_std": 5e-5, "depth_quantum": 1e-4, "image_lag": 0.077,
        "node_force_share": 0.2, "tracking_std": 1.5e-4, "window": 0.836,
    },
    "gen3": {"force_std": 0.0, "torque_std": 0.1, "torque_offset_std": 0.5, "torque_drift_std": 0.01},
    "gen3-posed": {"force_std": 0.0, "torque_std": 0.08, "torque_pose_std": 0.4, "torque_pose_length": 0.3,
                   "torque_hysteresis": 0.3},
}
"""``kind`` of a task's ``[noise]``: values of the keys that the task does not give.

"punyo": measured on 150 frames of a real Punyo at 30 Hz.
"punyo-window": the same with what its inside camera sees and how well it follows it: 227 of 326 inner nodes, which is
the dome out to 0.8 to 0.88 of its rim, and a drift across the ray of 0.1 to 0.2 mm over a touch, an assumption.
"gen3": the joint torques of a Kinova Gen3, whose maker publishes no noise. Offset: users zero their torques by hand
after every start and find offsets of newton metres (Kinova-kortex2_Gen3_G3L, issues 38 and 189; ros_kortex, issue 237).
White noise and drift are assumptions: 0.1 % of the peak torque, and a tenth of that after a second.
"gen3-posed": the same arm's errors as far as a real data set shows them. In openvsf's notebook
demos/vsf_playground.ipynb a touch that meets almost nothing leaves 0.45 N m a joint after the tare, a norm of 1.2, and
the offset moves by 0.39 N m from touch to touch. Kortex issue 145 shows that readings depend on the direction of
motion. The division into an error of the gravity model and hysteresis of the drives is an assumption that gives those
figures."""

SIGNED = ("pressure_drift",)
"""Keys that may be negative."""

FREE_FORCE = 1e-6
"""A frame is contact-free if the noise-free force is below this [N]: rounding error of the solver, far below the noise
of any sensor."""


def stream(noise: Noise, object_index: int, view_index: int, touch_index: int, *channel: int) -> np.random.Generator:
    """The random stream of one touch; ``channel`` separates the sensors from the force, which has none."""
    return np.random.default_rng(np.random.SeedSequence(noise.seed,
                                                        spawn_key=(object_index, view_index, touch_index, *channel)))


def noisy_force(force: np.ndarray, noise: Noise, *, object_index: int, view_index: int, touch_index: int,
                time: np.ndarray | None = None) -> np.ndarray:
    """The noise-free force of a touch as a real sensor would show it.

    Args:
        force: noise-free contact force on the probe (T, 3) [N]; NaN rows (unconverged frames) stay NaN.
        noise: its parameters.
        object_index, view_index, touch_index: of the touch; they select the random stream.
        time: of the frames (T,) [s]; needed with a ``force_lag``.

    Returns:
        (T, 3) [N].
    """
    rng = stream(noise, object_index, view_index, touch_index)
    frames = len(force)
    offset = noise.offset_std * rng.standard_normal(3)
    drift = noise.drift_std * rng.standard_normal(3)
    white = noise.force_std * rng.standard_normal((frames, 3))
    late = force
    if noise.force_lag:
        assert time is not None, "a late force needs the times of the frames"
        late = delayed(force, time, noise.force_lag)
    return tared(late + offset + drift * np.linspace(0.0, 1.0, frames)[:, None] + white, force, noise)


def tared(reading: np.ndarray, force: np.ndarray, noise: Noise) -> np.ndarray:
    """``reading`` (T, ...) minus the mean of its first contact-free frames, which the noise-free ``force`` (T, 3) [N]
    determines."""
    free = np.linalg.norm(np.nan_to_num(force, nan=np.inf), axis=1) < FREE_FORCE
    leading = len(force) if free.all() else int(np.argmin(free))
    tare = min(leading, noise.tare_frames)
    return reading - reading[:tare].mean(axis=0) if tare else reading


def delayed(signal: np.ndarray, time: np.ndarray, lag: float) -> np.ndarray:
    """A signal (T, ...) at the times (T,) [s], delayed by ``lag`` [s].

    It is linear between the frames, and constant before the first one. Frames with a NaN are bridged and stay NaN.
    """
    flat = signal.reshape(len(signal), -1)
    good = np.isfinite(flat).all(axis=1)
    if lag == 0.0 or not good.any():
        return signal.copy()
    known, at = np.asarray(time, float)[good], np.asarray(time, float) - lag
    after = np.clip(np.searchsorted(known, at), 1, max(len(known) - 1, 1))
    values = flat[good]
    if len(known) == 1:
        out = np.repeat(values, len(flat), axis=0)
    else:
        share = np.clip((at - known[after - 1]) / (known[after] - known[after - 1]), 0.0, 1.0)[:, None]
        out = (1.0 - share) * values[after - 1] + share * values[after]
    return np.where(good[:, None], out, np.nan).reshape(signal.shape)
