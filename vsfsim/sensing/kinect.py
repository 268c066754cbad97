"""Errors of the depth of real cameras.

`with_depth_errors` takes those of a `DepthCamera`: noise of each pixel that grows with depth, an error common to the
picture, steps of the stored depth, and lost pixels at depth edges. `kinect_depth` is the noise of the released plants:
the noise grows with distance, depth is quantised to whole millimetres, and pixels along depth edges are lost.

    z' = 1 mm * round((z + N(0, s(z))) / 1 mm),   s(z) = 0.5 mm + 0.9 mm (z / 1 m)^2

The standard deviation follows measurements of such a camera (Toelgyessy et al. 2021, Sensors 21:413: about 1 mm at 1 m,
a few millimetres at 3 m). The share of pixels lost where a near and a far surface mix in one pixel is an assumption.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vsfsim.core.scene_tables.camera import DEPTH_CAMERAS, CameraSpec, DepthCamera
from vsfsim.data.records import View

STEP = 0.02  # jump in depth between neighbouring pixels that counts as an edge [m]
LOST = 0.35  # share of the edge pixels without a depth [-]
QUANTUM = 0.001  # of the stored depth [m]


def kinect_depth(view: View, seed: np.random.SeedSequence | int) -> View:
    """The view with noisy ``depth`` and without the lost pixels in ``mask``; colours are unchanged."""
    rng = np.random.default_rng(seed)
    z = view.depth.astype(np.float64)
    noise, lost = rng.standard_normal(z.shape), rng.uniform(size=z.shape) < LOST
    keep = view.mask & ~(_edges(view) & lost)
    out = QUANTUM * np.round((z + (0.0005 + 0.0009 * z**2) * noise) / QUANTUM)
    return dataclasses.replace(view, depth=np.where(keep, out, 0.0).astype(np.float32), mask=keep)


def with_depth_errors(view: View, camera: DepthCamera, seed: np.random.SeedSequence | int) -> View:
    """The view with the errors of ``camera`` in ``depth`` and without the lost pixels in ``mask``."""
    rng = np.random.default_rng(seed)
    z = view.depth.astype(np.float64)
    noise, lost = rng.standard_normal(z.shape), rng.uniform(size=z.shape) < camera.lost
    bias = camera.bias * rng.uniform(-1.0, 1.0)
    keep = view.mask & ~(_edges(view) & lost)
    out = camera.quantum * np.round((z + bias + depth_std(camera, z) * noise) / camera.quantum)
    return dataclasses.replace(view, depth=np.where(keep, out, 0.0).astype(np.float32), mask=keep)


def depth_std(camera: DepthCamera, depth: np.ndarray) -> np.ndarray:
    """Standard deviation of a pixel [m] at ``depth`` [m], of the same shape."""
    at, std = np.transpose(camera.curve)
    beyond = (std[-1] - std[-2]) / (at[-1] - at[-2]) * np.maximum(depth - at[-1], 0.0)
    return np.interp(depth, at, std) + beyond


def seen_by(view: View, spec: CameraSpec, seed: np.random.SeedSequence | int) -> View:
    """What the camera ``spec`` records of an exact view; the view itself for an ideal camera."""
    if spec.model:
        return with_depth_errors(view, DEPTH_CAMERAS[spec.model], seed)
    return kinect_depth(view, seed) if spec.noise == "kinect" else view


def _edges(view: View) -> np.ndarray:
    """Pixels beside a jump in depth or the object's outline (H, W)."""
    z = view.depth.astype(np.float64)
    far = np.where(view.mask, z, np.inf)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            beside = np.roll(far, shift, axis=axis)
            with np.errstate(invalid="ignore"):
                edge |= np.abs(np.where(np.isfinite(beside), beside, z + 1.0) - z) > STEP
    return edge
