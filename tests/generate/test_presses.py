"""Presses of several kinds in one scene, and tasks that ask for those that were not felt."""

import dataclasses
import json

import numpy as np
import pytest
from texts import text

from vsfsim.baselines.near_springs import NearSprings
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import divide, record, specimen
from vsfsim.bench.task import load_task, parse_task
from vsfsim.core.errors import DatasetError, SceneError
from vsfsim.core.scene import load_scene
from vsfsim.core.shape import Cylinder, Sphere
from vsfsim.core.shelf import find_scene
from vsfsim.data.hdf5 import encode_view, read_view
from vsfsim.generate.effectors.probe import EFFECTOR
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe

PUNCH = Cylinder(0.008, 0.02)


@pytest.fixture(scope="module")
def made(generated):
    return generated("kinds")


@pytest.fixture(scope="module")
def task():
    return parse_task(text("kinds-v1"), "kinds-v1.toml")


def test_every_second_touch_is_another_press_in_turn(made):
    view = made.load(made.entries[0].name)
    assert [touch.press for touch in view.touches] == [0, 1, 0, 2, 0, 1, 0, 2]
    assert [view.probe_of(touch) for touch in view.touches[:4]] == [Sphere(0.01), PUNCH, Sphere(0.01), Sphere(0.01)]
    for touch in view.touches:
        way = (touch.mount_pose[-1] - touch.mount_pose[0])[:3, 3]
        tilt = np.arccos(np.clip(-touch.axis @ touch.normal, -1.0, 1.0))
        assert touch.converged.all() and touch.touched
        if touch.press == 1:
            assert tilt < 1e-6 and touch.probe_pose()[-1, :3, 2] @ touch.axis == pytest.approx(-1.0)
        elif touch.press == 2:
            assert touch.axis[2] == 0.0 and way[2] == pytest.approx(0.0, abs=1e-12)
            assert np.cross(touch.axis, -touch.normal)[2] == pytest.approx(0.0, abs=1e-9)
        else:
            assert tilt <= 0.3 + 1e-9


def test_the_scenes_own_touches_are_those_of_the_scene_without_others(made, tmp_path):
    """So that a transfer task has the objects and the pictures of the task that it belongs to."""
    whole = text("kinds")
    (tmp_path / "kinds.toml").write_text(whole[:whole.index("[[touches.other]]")] + whole[whole.index("[camera]"):])
    job = jobs_of(make_recipe(load_scene(tmp_path / "kinds.toml")), tmp_path / "kinds.toml", tmp_path)[0]
    plain = EFFECTOR.make_view(job, device="cpu")
    view = made.load("kinds-0000-v0")
    np.testing.assert_array_equal(view.view.depth, plain.view.depth)
    np.testing.assert_array_equal(view.truth.young_modulus, plain.truth.young_modulus)
    for k in range(0, 8, 2):
        np.testing.assert_array_equal(view.touches[k].mount_pose, plain.touches[k].mount_pose)
        np.testing.assert_allclose(view.touches[k].force, plain.touches[k].force, rtol=2e-4, atol=1e-7)
    assert all(touch.press is None for touch in plain.touches) and plain.others == ()


@pytest.mark.parametrize(("old", "new"), [("depth = 0.002", "depth = -1.0"), ("level = true", "level = 3"),
                                          ("level = true", "levels = true")])
def test_a_wrong_press_of_another_kind_is_named_by_its_row(tmp_path, old, new):
    (tmp_path / "kinds.toml").write_text(text("kinds").replace(old, new))
    row = 1 if "depth" in old else 2
    with pytest.raises(SceneError, match=rf"kinds.toml \[\[touches.other\]\] {row}: .*{new.split()[0]}"):
        load_scene(tmp_path / "kinds.toml")


def test_queries_are_other_presses_and_only_the_scenes_own_are_learned_from(made, task):
    view = made.blind().load(made.entries[0].name)
    draw, asked = divide(view, task.protocol), record(view, task).queries
    assert len(draw.query) == 3 and set(draw.query) < {1, 3, 5, 7} and draw.pool == (0, 2, 4, 6)
    assert {asked[k].action.probe for k in (1, 5)} == {PUNCH}
    learned = specimen(view, task).touches
    assert [reading.action.probe for reading in learned] == [Sphere(0.01)] * 4
    here = dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, transfer=False))
    assert len(specimen(view, here).touches) == 8 and len(divide(view, here.protocol).pool) == 5


def test_the_true_object_answers_other_presses_and_a_method_sees_what_presses(made, task):
    ceiling = evaluate("resim", task, made)
    assert all(score.mean < 1e-3 for score in ceiling.scores["rmse_ratio"].values())
    method, view = NearSprings(), made.blind().load(made.entries[0].name)
    method.meta_fit([specimen(view, task)])
    method.adapt(view.view, specimen(view, task).touches)
    punch = record(view, task).queries[1].action
    flat, ball = method.predict([punch, dataclasses.replace(punch, probe=Sphere(0.008))])
    assert flat[-1, 0] > ball[-1, 0] == 0.0, "the face of the punch is 10 mm ahead of its centre, the ball 8 mm"


def test_a_file_holds_the_shapes_and_refuses_a_press_without_one(made, tmp_path):
    view = made.load(made.entries[0].name)
    (tmp_path / "a.h5").write_bytes(encode_view(view))
    found = read_view(tmp_path / "a.h5")
    assert (found.probe, found.others) == (view.probe, (PUNCH, Sphere(0.01)))
    assert [touch.press for touch in found.touches] == [touch.press for touch in view.touches]
    (tmp_path / "b.h5").write_bytes(encode_view(dataclasses.replace(view, others=view.others[:1])))
    with pytest.raises(DatasetError, match="touches/003/press is 2, but attribute 'probe' has 2 shapes"):
        read_view(tmp_path / "b.h5")


def test_the_released_task_asks_enough_of_the_same_shoes():
    task = load_task("transfer-shoes-mini-v1")
    scene = load_scene(find_scene(task.dataset.scene))
    own = json.loads(json.dumps(scene.tree))
    plain = load_scene(find_scene(scene.name.replace("transfer", "v3"))).tree
    assert own["object"].pop("resolution") == 0.010
    assert [own[key] for key in ("object", "probe", "camera", "gravity")] == [
        plain[key] for key in ("object", "probe", "camera", "gravity")]
    spec = scene.sample(0).required_touches
    kinds = [spec.kind(k) for k in range(task.dataset.touches)]
    assert task.protocol.transfer and kinds.count(0) >= max(task.protocol.shots)
    assert sum(kind > 0 for kind in kinds) >= task.protocol.query and min(map(kinds.count, (1, 2, 3))) >= 2
