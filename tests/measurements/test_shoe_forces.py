"""Forces of the parts of shoes: travel counts from contact, and the parts have the materials of their model."""

from types import SimpleNamespace

import numpy as np
import pytest

from measurements.shoe_forces import _classes, default_folder, materials, travel
from vsfsim.bench.task import load_task
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import scenes, tasks
from vsfsim.generate.recipe import make_recipe
from vsfsim.scenes._footwear_models import MODELS, PARTS


def touch(force, *, step=0.004, converged=None):
    """A touch along -z whose frames are ``step`` apart."""
    pose = np.tile(np.eye(4), (len(force), 1, 1))
    pose[:, 2, 3] = -step * np.arange(len(force))
    force = np.asarray(force, float)
    return SimpleNamespace(mount_pose=pose, axis=np.array([0.0, 0.0, -1.0]), normal_force=lambda: force,
                           converged=np.ones(len(force), bool) if converged is None else np.array(converged, bool))


def test_travel_begins_at_contact():
    # a spring of 1 N/mm that is met at 6 mm: frames at 0, 4, 8, 12, 16 mm
    far, force = travel(touch([0.0, 0.0, 2.0, 6.0, 10.0]))
    assert far == pytest.approx([0.0, 0.002, 0.006, 0.010]) and np.interp(0.005, far, force) == pytest.approx(5.0)
    # contact cannot begin before the last frame without it: the second step is the soft one
    far, _ = travel(touch([0.0, 0.0, 6.0, 7.0]))
    assert far == pytest.approx([0.0, 0.004, 0.008])


def test_frames_that_did_not_converge_are_left_out():
    far, force = travel(touch([0.0, 0.0, 2.0, np.nan, 10.0], converged=[1, 1, 1, 0, 1]))
    assert len(far) == 3 and np.isfinite(force).all()
    assert not len(travel(touch([0.0, 0.0, 0.0]))[0])


def test_the_default_is_the_dataset_of_the_task_of_its_scene():
    (task,) = (task for task in map(load_task, tasks()) if task.dataset.scene == "shoes-v2-mini")
    assert default_folder() == task.dataset.path()


def test_the_spread_of_classes_is_set_against_that_of_their_shoes():
    text = 'object = { shape = { model = { each = ["work-boot", "road-runner"] } } }'
    entries = [SimpleNamespace(object_index=k) for k in range(4)]
    dataset = SimpleNamespace(recipe=SimpleNamespace(scene_text=text), entries=entries, path="here")
    _, spreads = _classes(dataset, {0: [1.0, 3.0], 1: [0.0], 2: [1.0], 3: [2.0]})
    # boots 2 and 1, runners 0 and 2: variances 0.5 and 2, means 1.5 and 1
    assert [row["spread"] for row in spreads.rows] == pytest.approx(np.exp([1.25**0.5, 0.125**0.5, 0.625**0.5]))
    assert _classes(dataset, {0: [1.0]}) == [], "one shoe has no spread"


def test_the_materials_are_those_of_the_model():
    recipe = make_recipe(load_scene(scenes()["shoes-v2-mini"]))
    assert materials(recipe, 5) == dict(zip(PARTS, MODELS["cushioned-runner"].materials, strict=True))
    with pytest.raises(SceneError, match="not named shoes"):
        materials(make_recipe(load_scene(scenes()["rope-punyo-mini"])), 0)
