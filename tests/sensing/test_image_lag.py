"""Late images of a moving bubble: what they do to the estimated forces, and their alignment."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import bubble, patch

from vsfsim.bench.mock import mock_view
from vsfsim.bench.noise import NOISE_KINDS, Noise, noisy_nodes
from vsfsim.sensing.bubble_touch import aligned_nodes, estimate_forces
from vsfsim.sensing.membrane_fe import SensorError

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
    with pytest.raises(SensorError, match="lag -1"):
        aligned_nodes(world, pose, time, -1.0)
    with pytest.raises(SensorError, match="times"):
        aligned_nodes(world, pose, time[:3], 0.077)


def test_late_images_lose_the_forces_and_alignment_finds_them():
    toy = bubble(6)
    full, frames = patch(toy, (0.012, 0.004), 0.016, 5.0), 9
    position, pressure, force, x = [], [], [], None
    for share in np.linspace(0.0, 1.0, frames):
        x, p = toy.push(share * full, start=x)
        position.append(x)
        pressure.append(p)
        force.append(share * full)
    pose, time, force = np.tile(np.eye(4), (frames, 1, 1)), 0.1 * np.arange(frames), np.array(force)
    touch = replace(mock_view(0, split="test", touches=1).touches[0], mount_pose=pose, time=time,
                    converged=np.ones(frames, bool), pressure=np.array(pressure), rest_pressure=toy.pressure,
                    node_position=np.array(position), node_rest=toy.rest, node_reference=toy.flat,
                    node_triangles=toy.triangles)
    middle = slice(3, 7)
    error = {}
    for name, given, taken in (("in time", 0.0, 0.0), ("late", 0.077, 0.0), ("aligned", 0.077, 0.077)):
        late = noisy_nodes(touch.node_position, pose, time, noise(image_lag=given), **WHICH)
        found = estimate_forces(touch, stiffness=680.0, position=late, image_lag=taken)
        assert np.isfinite(found.force[middle]).all() and found.converged[middle].all()
        error[name] = np.linalg.norm(found.force[middle] - force[middle]) / np.linalg.norm(force[middle])
        assert np.isnan(found.force[-1]).all() == (taken > 0.0) == (not found.converged[-1])
    print(error)
    # a push of 0.6 N a frame, so 0.5 N in the lag
    assert error["late"] > 2.0 * error["in time"] and error["aligned"] < 1.25 * error["in time"]
