"""Models of real RGB-D cameras: their noise, bias and lost pixels, in the view and in a scene."""

from pathlib import Path

import numpy as np
import pytest
from texts import scene

from vsfsim.core.scene_tables.object import DEPTH_CAMERAS, CameraSpec
from vsfsim.data.records import View
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.sensing.camera import seen_by

PATH = Path("seen.toml")


def wall(depth: float) -> View:
    mask = np.pad(np.ones((80, 100), bool), 10)
    return View(np.zeros((100, 120, 3), np.uint8), np.where(mask, depth, 0.0).astype(np.float32), mask, np.eye(3),
                np.eye(4))


@pytest.mark.parametrize(("name", "depth", "std"), [
    ("azure-kinect", 2.0, 1.2e-3), ("l515", 1.0, 2.5e-3), ("l515", 9.0, 15.5e-3)])
def test_noise_grows_with_depth_as_the_sources_say(name: str, depth: float, std: float) -> None:
    camera = DEPTH_CAMERAS[name]
    seen = seen_by(wall(depth), CameraSpec(model=name), 3)
    # of the 7000 pixels a standard deviation is known within a per cent; the quantum adds its own
    found = seen.depth[seen.mask].std()
    assert found == pytest.approx(np.hypot(std, camera.quantum / np.sqrt(12.0)), rel=0.04)
    assert abs(float(seen.depth[seen.mask].mean()) - depth) < camera.bias + 1e-4
    steps = seen.depth[seen.mask].astype(float) / camera.quantum
    assert np.abs(steps - np.rint(steps)).max() < 0.02


def test_pixels_are_lost_at_edges_only_and_the_seed_decides() -> None:
    camera = DEPTH_CAMERAS["l515"]
    flat = wall(0.8)
    one, two, other = (seen_by(flat, CameraSpec(model="l515"), seed) for seed in (1, 1, 2))
    assert np.array_equal(one.depth, two.depth) and not np.array_equal(one.depth, other.depth)
    lost = flat.mask & ~one.mask
    assert not lost[11:-11, 11:-11].any() and lost.sum() == pytest.approx(camera.lost * 356, rel=0.3)
    assert (one.depth[~one.mask] == 0.0).all()


def test_a_scene_names_a_camera() -> None:
    seen = scene("seen")
    camera = seen.sample(0).camera
    assert (camera.width, camera.height) == (64, 48) and camera.fov == pytest.approx(np.radians(55.0))
    subject = prepare(jobs_of(make_recipe(seen, objects=1), PATH, Path())[0], device="cpu")
    change = (subject.recorded.depth - subject.view.depth)[subject.recorded.mask]
    assert 0.0 < np.abs(change).max() < 0.02 and change.std() > 1e-4
    plain = scene("seen", model=None)
    ideal = prepare(jobs_of(make_recipe(plain, objects=1), PATH, Path())[0], device="cpu")
    assert ideal.recorded is ideal.view
