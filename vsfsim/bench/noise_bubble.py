"""The noise of an air-filled bubble's readings: the pressure, and the node positions made from its depth images.

Pressure: first the relaxation of air and rubber, y = x + r (x - l) of the noise-free change x, where the low pass l
follows x with the time constant tau, so that a step overshoots by r of itself and then decays. The noise-free
(quasi-static) pressure is the settled one, because the stiffness of skin and air was fitted to held frames. Then drift
and white noise, then the tare.

Node positions: a node moves along its ray to the camera by the error of its depth, which is white noise followed by
rounding to the quantum, and it is delayed. Across the ray it drifts, smoothly over the skin, as the touch goes on. Only
nodes in the camera's window are shown.
"""

from __future__ import annotations

import math

import numpy as np

from vsfsim.bench.noise import Noise, delayed, stream, tared
from vsfsim.core.errors import TaskError

_PRESSURE, _TRACKING, _NODES, _NODE_FORCE = 1, 2, 3, 5  # channels of the random streams; 4 is the torques'
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


def noisy_pressure(pressure: np.ndarray, time: np.ndarray, force: np.ndarray, noise: Noise, *, object_index: int,
                   view_index: int, touch_index: int) -> np.ndarray:
    """The noise-free pressure of a touch as a real sensor would show it.

    Args:
        pressure: noise-free (T,) [Pa]; NaN (unconverged frames) stays NaN.
        time: of the frames (T,) [s], increasing.
        force: noise-free contact force (T, 3) [N], which determines the contact-free frames of the tare.
        noise: its parameters.

    Returns:
        (T,) [Pa]; if frames were tared, the change against their mean.
    """
    rng = stream(noise, object_index, view_index, touch_index, _PRESSURE)
    rate = noise.pressure_drift + noise.pressure_drift_std * rng.standard_normal()
    white = noise.pressure_std * rng.standard_normal(len(pressure))
    good = np.isfinite(pressure)
    out = np.full(len(pressure), np.nan)
    if good.any():
        out[good] = relaxed(pressure[good], time[good], noise.relaxation, noise.relaxation_time)
    return tared(out + rate * (time - time[0]) + white, force, noise)


def quantised(value: np.ndarray, step: float) -> np.ndarray:
    """Rounded to multiples of ``step``; as it is for a step of 0."""
    return step * np.rint(value / step) if step else value


def noisy_nodes(position: np.ndarray, mount_pose: np.ndarray, time: np.ndarray, noise: Noise, *, object_index: int,
                view_index: int, touch_index: int,
                origin: tuple[float, float, float] = CAMERA_ORIGIN, tilt: float = CAMERA_TILT) -> np.ndarray:
    """The read-out nodes of a touch as the inside camera would locate them.

    A node has its true pixel and a noisy, quantised depth, so it moves along its ray. It is delayed by ``image_lag`` in
    the frame of the mount; the arm's pose is not delayed. Across the ray it drifts by a smooth field (``tracking_std``)
    that grows evenly from the first frame to the last.

    Args:
        position: world (T, N, 3) [m]; NaN rows stay NaN.
        mount_pose: mount to world (T, 4, 4) [m].
        time: of the frames (T,) [s].
        noise: its parameters.
        object_index, view_index, touch_index: of the touch; they select the random stream.
        origin, tilt: of the camera in the mount frame (3,) [m], [rad].

    Returns:
        World (T, N, 3) [m].

    Raises:
        TaskError: the shapes do not fit, or a node is at or behind the camera.
    """
    position, mount_pose = np.asarray(position, np.float64), np.asarray(mount_pose, np.float64)
    if position.ndim != 3 or position.shape[2] != 3 or mount_pose.shape != (len(position), 4, 4):
        raise TaskError(f"noise: node positions {position.shape} and mount poses {mount_pose.shape}; they must be (T, "
                        f"N, 3) and (T, 4, 4).")
    rotation, shift = mount_pose[:, :3, :3], mount_pose[:, :3, 3]
    local = np.einsum("tni,tij->tnj", position - shift[:, None], rotation)
    local = delayed(local, time, noise.image_lag)
    ray = local - np.asarray(origin)
    axis = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    depth = ray @ axis
    if (depth <= 0.0).any():
        raise TaskError("noise: a node lies behind the inside camera; give the camera's origin and tilt of "
                        "this sensor.")
    white = noise.depth_std * stream(noise, object_index, view_index, touch_index, _NODES).standard_normal(depth.shape)
    measured = quantised(depth + white, noise.depth_quantum)
    local = np.asarray(origin) + ray * (measured / depth)[..., None]
    if noise.tracking_std:
        rng = stream(noise, object_index, view_index, touch_index, _TRACKING)
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


def noisy_node_force(force: np.ndarray, time: np.ndarray, noise: Noise, *, object_index: int, view_index: int,
                     touch_index: int) -> np.ndarray:
    """Contact forces on nodes (T, N, 3) [N] with the error of an estimate: delayed like the images it is made from, and
    with a relative error.

    The errors are normal and independent in x, y, z and between nodes, with the standard deviation that gives the RMS
    error over the nodes in contact. Nodes without contact stay at 0, as an estimator with a sparse solution leaves
    them. NaN rows stay NaN.

    Raises:
        TaskError: the shapes do not fit.
    """
    force = np.asarray(force, np.float64)
    if force.ndim != 3 or force.shape[2] != 3 or np.shape(time) != force.shape[:1]:
        raise TaskError(f"noise: node forces {force.shape} and times {np.shape(time)}; they must be (T, N, "
                        f"3) and (T,).")
    late = delayed(force, time, noise.image_lag)
    size = np.linalg.norm(late, axis=2)
    in_contact = size > 0.0
    rms = np.sqrt((size**2).sum(axis=1) / np.maximum(in_contact.sum(axis=1), 1))
    white = stream(noise, object_index, view_index, touch_index, _NODE_FORCE).standard_normal(force.shape)
    return late + np.where(in_contact, noise.node_force_share * rms[:, None] / math.sqrt(3.0), 0.0)[..., None] * white
