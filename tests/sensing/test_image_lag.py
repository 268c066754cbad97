"""Late images of a moving bubble: what they do to the estimated forces, and their alignment."""

import numpy as np

from vsfsim.bench.noise import NOISE_KINDS, Noise, noisy_nodes
from vsfsim.sensing.bubble_touch import aligned_nodes

WHICH = {"object_index": 0, "view_index": 0, "touch_index": 0}


def noise(**change: float) -> Noise:
    """Of a real Punyo."""
    base = {"offset_std": 0.0, "drift_std": 0.0, "tare_frames": 0, "seed": 0}
    return Noise(**{**base, **NOISE_KINDS["punyo"], **change})


def test_alignment_undoes_the_lag_of_an_even_motion():
    """The skin moves evenly in the frame of the mount, which itself moves and turns."""
    rng = np.random.default_rng(0)
    time = np.arange(8) * 0.1
    local = rng.uniform(-0.01, 0.01, (1, 5, 3)) + time[:, None, None] * rng.uniform(-0.02, 0.02, (1, 5, 3))
    angle = 0.3 * time
    pose = np.tile(np.eye(4), (8, 1, 1))
    pose[:, 0, 0] = pose[:, 1, 1] = np.cos(angle)
    pose[:, 1, 0], pose[:, 0, 1] = np.sin(angle), -np.sin(angle)
    pose[:, 2, 3] = -0.03 * time
    world = np.einsum("tni,tji->tnj", local, pose[:, :3, :3]) + pose[:, None, :3, 3]
    world[3] = np.nan  # a frame that did not converge
    late = noisy_nodes(world, pose, time, noise(depth_std=0.0, depth_quantum=0.0), **WHICH)
    found = aligned_nodes(late, pose, time, 0.077)
    # the delay holds the first frame before the touch began, so the first image that moves is the second
    assert np.abs(found[[1, 2, 4, 5, 6]] - world[[1, 2, 4, 5, 6]]).max() < 1e-12
    assert np.nanmax(np.abs(late - world)[1:]) > 1e-3
    assert np.isnan(found[3]).all() and np.isnan(found[7]).all(), "its image is taken after the touch"
    assert np.abs(aligned_nodes(world[:3], pose[:3], time[:3], 0.0) - world[:3]).max() < 1e-15
    assert np.isnan(aligned_nodes(late[:1], pose[:1], time[:1], 0.077)).all()
