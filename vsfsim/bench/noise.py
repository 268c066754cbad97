"""The noise of the sensors, added to noise-free touches when a task loads them.

Force: the reading of frame t of a touch is f(t - lag) + b + r t / (T - 1) + w(t): an offset b and a drift r drawn once
a touch, and white noise w, each normal and independent in x, y, z. Then the touch is tared: the mean of its first
contact-free frames is subtracted, as with a real sensor.

Pressure of a bubble: first the relaxation of air and rubber, y = x + r (x - l) of the noise-free change x, where the
low pass l follows x with the time constant tau, so that a step overshoots by r of itself and then decays. The
noise-free (quasi-static) pressure is the settled one, because the stiffness of skin and air was fitted to held frames.
Then drift and white noise, then the tare.

Node positions of a bubble: the error of their depth, delay and drift (`noisy_nodes`), in the camera's window only.

Joint torques: white noise, an offset a touch, a random walk, an error of the arm's gravity model that varies with
posture, and hysteresis of the drives, minus the tare. The gravity model's error is one random function of the joint
angles for every joint, a Gaussian process with a squared exponential covariance (by 256 random Fourier features), the
same in all touches, as that of one real arm. It does not depend on joint 1, whose axis is vertical. The hysteresis adds
or subtracts a constant for each joint by the sign of its velocity; a joint that stands still keeps its last sign, and
that before a touch is random.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from vsfsim.core.errors import TaskError

Count = Annotated[int, msgspec.Meta(ge=0)]
Signed = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Size = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
# channels of the random streams; the force has none
_PRESSURE, _TRACKING, _NODES, _TORQUE, _NODE_FORCE, _ARM, _SIGN = range(1, 8)


@dataclass(frozen=True)
class Noise:
    """Parameters of the sensors' noise; see the noise of each channel for what they do."""

    force_std: Size
    """White noise of the force, per component [N]."""
    offset_std: Size
    """Offset of the force in a touch, per component [N]."""
    drift_std: Size
    """Change of the force's offset from the first to the last frame of a touch, per component [N]."""
    tare_frames: Count
    """Greatest number of leading contact-free frames whose mean is subtracted; 0 for no tare."""
    seed: Count
    """Root of the random streams; each touch of each view of each object has its own."""
    force_lag: Size = 0.0
    """Delay of the force relative to the pressure [s]."""
    pressure_std: Size = 0.0
    """White noise of the pressure [Pa]."""
    pressure_drift: Signed = 0.0
    """Mean rate of the pressure's drift [Pa/s]."""
    pressure_drift_std: Size = 0.0
    """Standard deviation of that rate over touches [Pa/s]."""
    relaxation: Size = 0.0
    """Fraction of a change of pressure by which the sensor overshoots at first [-]."""
    relaxation_time: Annotated[float, msgspec.Meta(gt=0.0, le=1e9)] = 0.15
    """Time constant with which the overshoot decays [s]."""
    depth_std: Size = 0.0
    """White noise of a pixel's depth [m]."""
    depth_quantum: Size = 0.0
    """Quantisation step of the depth [m]; 0 for none."""
    image_lag: Size = 0.0
    """Delay of images, and of node positions made from them, relative to the pressure [s]."""
    tracking_std: Size = 0.0
    """Drift of a node across its ray at the end of a touch, per component [m], as of a tracker that accumulates its
    errors from frame to frame; 0 at the first frame."""
    tracking_length: Size = 0.010
    """Correlation length of that drift over the skin [m]."""
    window: Size = 0.0
    """Part of the rim's semi-axes within which the inside camera sees nodes [-]; nodes outside are not shown. 0: all
    are."""
    node_force_share: Size = 0.0
    """Error of an estimated contact force on a node, relative to the RMS force of the nodes in contact in that frame
    [-]."""
    torque_std: Size = 0.0
    """White noise of the torque sensors of joints 1 to 4 [N m]; here and below, joints 5 to 7 have half as much."""
    torque_offset_std: Size = 0.0
    """Offset of a torque in a touch [N m]."""
    torque_drift_std: Size = 0.0
    """Random walk of a torque after one second [N m]."""
    torque_pose_std: Size = 0.0
    """Standard deviation over postures of the error of the arm's gravity model at joints 2, 4 and 6, mean over arms
    [N m]; 0.375 of it at joints 1 and 3, 0.25 at 5 and 7."""
    torque_pose_length: Size = 0.3
    """Correlation length of that error in joint angles [rad]."""
    torque_hysteresis: Size = 0.0
    """Half of the drives' hysteresis, which changes its sign with a joint's velocity, mean over arms [N m]; of joints 5
    to 7 half as much."""


_PUNYO = {
    # images lag the pressure by 77 ms and the wrench by 58 ms, so the wrench lags the pressure by 19 ms
    "force_std": 0.14, "force_lag": 0.019,
    "pressure_std": 5.4, "pressure_drift": -1.6,  # -8 Pa in 5 s
    "relaxation": 0.02, "relaxation_time": 0.15,
    "depth_std": 5e-5, "depth_quantum": 1e-4, "image_lag": 0.077,
    # of a good force estimator at this depth noise, not of the sensor
    "node_force_share": 0.2,
}

NOISE_KINDS: Mapping[str, Mapping[str, float]] = {
    "punyo": _PUNYO, "punyo-window": {**_PUNYO, "tracking_std": 1.5e-4, "window": 0.836},
    "gen3-posed": {"force_std": 0.0, "torque_std": 0.08, "torque_pose_std": 0.4, "torque_pose_length": 0.3,
                   "torque_hysteresis": 0.3},
}
"""``kind`` of a task's ``[noise]``: values of the keys that the task does not give. "punyo" was measured on 150 frames
of a real Punyo at 30 Hz; what the others rest on stands in docs/sensing.md and docs/plants.md."""

FREE_FORCE = 1e-6
"""A frame is contact-free if the noise-free force is below this [N]: rounding error of the solver, far below the noise
of any sensor."""


def stream(noise: Noise, *channel: int, object_index: int, view_index: int, touch_index: int) -> np.random.Generator:
    """The random stream of one touch; ``channel`` separates the sensors from the force, which has none."""
    return np.random.default_rng(np.random.SeedSequence(noise.seed,
                                                        spawn_key=(object_index, view_index, touch_index, *channel)))


def noisy_force(force: np.ndarray, time: np.ndarray, known: np.ndarray, noise: Noise, **touch: int) -> np.ndarray:
    """The noise-free force of a touch as a real sensor would show it.

    Args:
        force: noise-free contact force on the probe (T, 3) [N]; NaN rows (unconverged frames) stay NaN.
        time: of the frames (T,) [s].
        known: the noise-free force that determines the contact-free frames of the tare (T, 3) [N].
        noise: its parameters.
        touch: object_index, view_index and touch_index, which select the random stream, here and below.

    Returns:
        (T, 3) [N].
    """
    rng = stream(noise, **touch)
    frames = len(force)
    offset = noise.offset_std * rng.standard_normal(3)
    drift = noise.drift_std * rng.standard_normal(3)
    white = noise.force_std * rng.standard_normal((frames, 3))
    late = delayed(force, time, noise.force_lag)
    return tared(late + offset + drift * np.linspace(0.0, 1.0, frames)[:, None] + white, known, noise)


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
    late = np.stack([np.interp(time - lag, time[good], column) for column in flat[good].T], axis=1)
    return np.where(good[:, None], late, np.nan).reshape(signal.shape)


_WAVES = 256  # of the drift: their sum is normal to a few per cent of its spread

CAMERA_ORIGIN, CAMERA_TILT = (-0.040, 0.0, -0.054), math.radians(25.0)
"""Position of the inside camera in the mount frame [m], and its tilt towards +x [rad]; see
`vsfsim.sensing.bubble_camera`."""


def relaxed(signal: np.ndarray, time: np.ndarray, share: float, seconds: float) -> np.ndarray:
    """y = x + share (x - l) of a signal x (T,) at times (T,) [s], with tau l' = x - l, exact for an x that is linear
    between frames."""
    low = np.empty_like(signal)
    low[:1] = signal[:1]
    for k in range(1, len(signal)):
        step = time[k] - time[k - 1]
        keep = math.exp(-step / seconds)
        slope = (signal[k] - signal[k - 1]) / step
        low[k] = signal[k] - slope * seconds + keep * (low[k - 1] - signal[k - 1] + slope * seconds)
    return signal + share * (signal - low)


def noisy_pressure(pressure: np.ndarray, time: np.ndarray, force: np.ndarray, noise: Noise, **touch: int) -> np.ndarray:
    """The noise-free pressure of a touch as a real sensor would show it.

    Args:
        pressure: noise-free (T,) [Pa]; NaN (unconverged frames) stays NaN.
        time: of the frames (T,) [s], increasing.
        force: noise-free contact force (T, 3) [N], which determines the contact-free frames of the tare.
        noise: its parameters.

    Returns:
        (T,) [Pa]; if frames were tared, the change against their mean.
    """
    rng = stream(noise, _PRESSURE, **touch)
    rate = noise.pressure_drift + noise.pressure_drift_std * rng.standard_normal()
    white = noise.pressure_std * rng.standard_normal(len(pressure))
    good = np.isfinite(pressure)
    out = np.full(len(pressure), np.nan)
    if good.any():
        out[good] = relaxed(pressure[good], time[good], noise.relaxation, noise.relaxation_time)
    return tared(out + rate * (time - time[0]) + white, force, noise)


def noisy_nodes(position: np.ndarray, mount_pose: np.ndarray, time: np.ndarray, noise: Noise, **touch: int
                ) -> np.ndarray:
    """The read-out nodes of a touch as the inside camera would locate them.

    A node has its true pixel and a noisy, quantised depth, so it moves along its ray. It is delayed by ``image_lag`` in
    the frame of the mount; the arm's pose is not delayed. Across the ray it drifts by a smooth field (``tracking_std``)
    that grows evenly from the first frame to the last.

    Args:
        position: world (T, N, 3) [m]; NaN rows stay NaN.
        mount_pose: mount to world (T, 4, 4) [m].
        time: of the frames (T,) [s].
        noise: its parameters.

    Returns:
        World (T, N, 3) [m].

    Raises:
        TaskError: a node is at or behind the camera.
    """
    rotation, shift = mount_pose[:, :3, :3], mount_pose[:, :3, 3]
    local = np.einsum("tni,tij->tnj", position - shift[:, None], rotation)
    local = delayed(local, time, noise.image_lag)
    ray = local - np.asarray(CAMERA_ORIGIN)
    axis = np.array([math.sin(CAMERA_TILT), 0.0, math.cos(CAMERA_TILT)])
    depth = ray @ axis
    if (depth <= 0.0).any():
        raise TaskError("noise: a node lies behind the inside camera, which is a Punyo's.")
    white = noise.depth_std * stream(noise, _NODES, **touch).standard_normal(depth.shape)
    measured = depth + white
    if noise.depth_quantum:
        measured = noise.depth_quantum * np.rint(measured / noise.depth_quantum)
    local = np.asarray(CAMERA_ORIGIN) + ray * (measured / depth)[..., None]
    if noise.tracking_std:
        rng = stream(noise, _TRACKING, **touch)
        wave = rng.standard_normal((_WAVES, 2)) / noise.tracking_length
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, 1, _WAVES))
        # on the skin at the first known frame; a sum of random waves has a Gaussian correlation (Rahimi, Recht 2007)
        first = local[int(np.isfinite(local).all(axis=(1, 2)).argmax()), :, :2]
        field = noise.tracking_std * np.sqrt(2.0 / _WAVES) * np.cos(first @ wave.T + phase).sum(axis=2)  # (2, N)
        gone = (time - time[0]) / max(float(time[-1] - time[0]), 1e-12)
        unit = ray / np.linalg.norm(ray, axis=2, keepdims=True)
        side = np.cross(unit, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side, axis=2, keepdims=True)
        across = field[0][:, None] * side + field[1][:, None] * np.cross(unit, side)
        local = local + gone[:, None, None] * across
    return np.einsum("tni,tji->tnj", local, rotation) + shift[:, None]


def window(rest: np.ndarray, noise: Noise) -> np.ndarray:
    """Which nodes the inside camera sees (N,) bool, by their places ``rest`` on the free dome, mount frame (N, 3) [m]:
    those over the rim's ellipse made smaller by ``noise.window``."""
    rest = np.asarray(rest, np.float64)
    if not noise.window:
        return np.ones(len(rest), bool)
    return np.hypot(*(rest[:, :2] / np.abs(rest[:, :2]).max(axis=0)).T) <= noise.window


def noisy_node_force(force: np.ndarray, time: np.ndarray, noise: Noise, **touch: int) -> np.ndarray:
    """Contact forces on nodes (T, N, 3) [N] with the error of an estimate: delayed like the images it is made from, and
    with a relative error.

    The errors are normal and independent in x, y, z and between nodes, with the standard deviation that gives the RMS
    error over the nodes in contact. Nodes without contact stay at 0, as an estimator with a sparse solution leaves
    them. NaN rows stay NaN.
    """
    late = delayed(force, time, noise.image_lag)
    size = np.linalg.norm(late, axis=2)
    in_contact = size > 0.0
    rms = np.sqrt((size**2).sum(axis=1) / np.maximum(in_contact.sum(axis=1), 1))
    white = stream(noise, _NODE_FORCE, **touch).standard_normal(force.shape)
    return late + np.where(in_contact, noise.node_force_share * rms[:, None] / math.sqrt(3.0), 0.0)[..., None] * white


_LARGE = 4  # joints 1 to 4 have the large actuators
_SMALL_SCALE = 0.5  # noise of the other joints relative to theirs, as their range
_POSE_SHARE = (0.375, 1.0, 0.375, 1.0, 0.25, 1.0, 0.25)  # of `Noise.torque_pose_std` at joints 1 to 7
_FEATURES = 256  # random Fourier features of the gravity model's error
_ARM_SPREAD = 0.25  # an arm's own error lies within this share of the mean over arms, a third more for the hysteresis
_STILL = 1e-5  # a joint that turns less between two frames stands still [rad]


def noisy_torque(torque: np.ndarray, time: np.ndarray, force: np.ndarray, noise: Noise, *,
                 q: np.ndarray | None = None, **touch: int) -> np.ndarray:
    """The noise-free torques of a touch as real sensors would show them.

    Args:
        torque: noise-free (T, J) [N m]; NaN rows (unconverged frames) stay NaN.
        time: of the frames (T,) [s].
        force: noise-free contact force (T, 3) [N], which determines the contact-free frames of the tare.
        noise: its parameters.
        q: joint angles (T, J) [rad]; without them there is neither an error in posture nor hysteresis.

    Returns:
        (T, J) [N m].
    """
    rng = stream(noise, _TORQUE, **touch)
    joints = torque.shape[1]
    size = np.where(np.arange(joints) < _LARGE, 1.0, _SMALL_SCALE)
    offset = noise.torque_offset_std * rng.standard_normal(joints)
    steps = np.sqrt(np.diff(time, prepend=time[:1]))[:, None] * rng.standard_normal(torque.shape)
    white = noise.torque_std * rng.standard_normal(torque.shape)
    reading = torque + size * (offset + noise.torque_drift_std * np.cumsum(steps, axis=0) + white)
    if q is not None and (noise.torque_pose_std or noise.torque_hysteresis):
        start = stream(noise, _SIGN, **touch).choice([-1.0, 1.0], joints)
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
    ``start`` (7,) is the sign of each joint's last motion before the touch."""
    rng = np.random.default_rng(np.random.SeedSequence(noise.seed, spawn_key=(_ARM, 1)))
    spread = 4.0 / 3.0 * _ARM_SPREAD
    height = noise.torque_hysteresis * rng.uniform(1.0 - spread, 1.0 + spread, q.shape[1])
    step = np.diff(q, axis=0, prepend=q[:1])
    sign = np.where(np.abs(step) > _STILL, np.sign(step), 0.0)
    sign[0] = start
    moved = np.maximum.accumulate(np.where(sign != 0.0, np.arange(len(q))[:, None], 0), axis=0)
    return height * np.take_along_axis(sign, moved, axis=0)
