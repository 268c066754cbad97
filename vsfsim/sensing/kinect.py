"""Depth noise of a time-of-flight camera such as Azure Kinect.

The noise grows with distance, depth is quantised to whole millimetres, and pixels along depth edges are lost.

    z' = 1 mm * round((z + N(0, s(z))) / 1 mm),   s(z) = 0.5 mm + 0.9 mm (z / 1 m)^2

The standard deviation follows measurements of such a camera (Toelgyessy et al. 2021, Sensors 21:413: about 1 mm at 1 m,
a few millimetres at 3 m). The share of pixels lost where a near and a far surface mix in one pixel is an assumption.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from vsfsim.data.records import View

STEP = 0.02  # jump in depth between neighbouring pixels that counts as an edge [m]
LOST = 0.35  # share of the edge pixels without a depth [-]
QUANTUM = 0.001  # of the stored depth [m]


def kinect_depth(view: View, seed: np.random.SeedSequence | int) -> View:
    """The view with noisy ``depth`` and without the lost pixels in ``mask``; colours are unchanged."""
    rng = np.random.default_rng(seed)
    z = view.depth.astype(np.float64)
    noise, lost = rng.standard_normal(z.shape), rng.uniform(size=z.shape) < LOST
    far = np.where(view.mask, z, np.inf)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            beside = np.roll(far, shift, axis=axis)
            with np.errstate(invalid="ignore"):
                edge |= np.abs(np.where(np.isfinite(beside), beside, z + 1.0) - z) > STEP
    keep = view.mask & ~(edge & lost)
    out = QUANTUM * np.round((z + (0.0005 + 0.0009 * z**2) * noise) / QUANTUM)
    return dataclasses.replace(view, depth=np.where(keep, out, 0.0).astype(np.float32), mask=keep)
