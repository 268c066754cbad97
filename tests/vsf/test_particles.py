"""Particle structure from a view: what is seen and what it hides."""


import numpy as np
import pytest

from vsfsim.data.records import View
from vsfsim.vsf.particles import particles_from_view

H, W, F = 120, 160, 200.0
HEIGHT = 0.5


def from_above() -> View:
    """A camera at z = 0.5 looking straight down at a 0.1 x 0.08 m patch of height 0.1."""
    column, row = np.meshgrid(np.arange(W), np.arange(H))
    intrinsics = np.array([[F, 0, (W - 1) / 2], [0, F, (H - 1) / 2], [0, 0, 1.0]])
    x, y = (column - intrinsics[0, 2]) / F, (row - intrinsics[1, 2]) / F
    depth = np.full_like(x, HEIGHT - 0.1)
    mask = (np.abs(x * depth) <= 0.05) & (np.abs(y * depth) <= 0.04)
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[2, 3] = HEIGHT
    return View(np.zeros((H, W, 3), np.uint8), np.where(mask, depth, 0).astype(np.float32), mask, intrinsics, pose)


def test_hidden_cone_below_a_flat_top():
    view = from_above()
    bounds = np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]])
    points = particles_from_view(view, bounds=bounds, spacing=0.005)
    assert points.dtype == np.float64
    # Nothing above the top; below it, exactly the pyramid of rays through the mask, to within half a pixel.
    assert points[:, 2].max() < 0.1 and points[:, 2].min() == pytest.approx(0.0025)
    depth = HEIGHT - points[:, 2]
    half = 0.5 / F
    assert np.all(np.abs(points[:, 0] / depth) <= 0.05 / 0.4 + half)
    grid = 0.0025 + 0.005 * np.arange(40)
    x, y, z = np.meshgrid(grid - 0.1, grid - 0.1, grid, indexing="ij")
    depth = HEIGHT - z
    sure = (z < 0.0999) & (np.abs(x / depth) <= 0.125 - half) & (np.abs(y / depth) <= 0.1 - half)
    kept = {tuple(np.round(p, 6)) for p in points}
    assert all(tuple(np.round(p, 6)) in kept for p in np.stack([x[sure], y[sure], z[sure]], axis=1))
    before = particles_from_view(view, bounds=bounds, spacing=0.005, tolerance=0.004)
    assert before[:, 2].max() == pytest.approx(0.1025), "points just before the surface are let in"


def test_order_is_z_then_y_then_x():
    everything = particles_from_view(from_above(), bounds=np.array([[-0.05, -0.05, 0.0], [0.05, 0.05, 0.1]]))
    assert np.array_equal(np.lexsort(everything.T), np.arange(len(everything)))
