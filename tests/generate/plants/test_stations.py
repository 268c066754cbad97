"""Touches that share a branch, pots that stand still, and frames that a nanometre changes."""

from __future__ import annotations

import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from texts import changed

import vsfsim
from vsfsim.bench.protocol import divide
from vsfsim.bench.task import Protocol
from vsfsim.core.errors import SceneError, TaskError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.core.system.exact import snapped
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe
from vsfsim.generate.plants.aim import SPAN, NothingReached, visible_branches
from vsfsim.generate.plants.subject import grow
from vsfsim.generate.plants.touches import agrees
from vsfsim.robot.reach import Reason, Unreachable
from vsfsim.scenes import _artificial_kinds as kinds


def scene(folder, **more):
    path = folder / "small.toml"
    path.write_text(changed(find_scene("plants-v5-mini").read_text(), plant='"orange-tree"', wood_segments=40,
                            leaf_segments=40, frames="{ free = 1, in = 8, hold = 0, out = 0 }", reject_below=0.0,
                            **more))
    return path


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    return grow(load_scene(scene(tmp_path_factory.mktemp("plant"))).sample(0), 0)


def test_parts_of_a_branch_follow_each_other_along_it(plant):
    """The visible points of a branch, in three parts, none of another branch."""
    rng, points, owner = np.random.default_rng(0), [], []
    for i in range(1, len(plant.nodes)):
        share = rng.uniform(size=(20, 1))
        a = plant.nodes[plant.parent[i]]
        points.append(a + share * (plant.nodes[i] - a))
        owner += [plant.look[i]] * 20
    cloud, owner = np.concatenate(points), np.array(owner)
    branches = visible_branches(plant, cloud, 3)
    assert branches
    for parts in branches:
        assert len(parts) == 3 and max(map(len, parts)) - min(map(len, parts)) <= 1
        own = [owner[np.flatnonzero((cloud == point).all(axis=1))[0]] for part in parts for point in part]
        assert np.mean(np.array(own) == np.bincount(own).argmax()) > 0.7  # where axes join, either may be nearer
        ends = [part.mean(axis=0) for part in parts]
        assert np.linalg.norm(ends[2] - ends[0]) > np.linalg.norm(ends[1] - ends[0]) > 0.0
        span = np.concatenate(parts)
        assert np.linalg.norm(span.max(axis=0) - span.min(axis=0)) >= 0.7 * SPAN
    assert visible_branches(plant, plant.nodes[:1], 3) == []


def test_three_touches_in_turn_share_a_branch_and_any_may_be_drawn_alone(tmp_path):
    from vsfsim.generate.job import jobs_of
    from vsfsim.generate.plants.subject import prepare_job
    from vsfsim.generate.recipe import make_recipe

    loaded = load_scene(scene(tmp_path, width=240, height=216))
    recipe = make_recipe(loaded, seed=0, objects=1, views=1, touches=6)
    subject = prepare_job(jobs_of(recipe, loaded.path, tmp_path)[0], device="cpu")
    assert isinstance(recipe, Recipe) and len(subject.aims) == 6
    targets = [aim.target for aim in subject.aims]
    branches = visible_branches(subject.plant, snapped(subject.view.points()), 3)
    for group in (targets[:3], targets[3:]):
        found = [[k for k, part in enumerate(parts) for target in group if (part == target).all(axis=1).any()]
                 for parts in branches]
        assert [0, 1, 2] in map(sorted, found)


def test_a_fixed_pot_is_clamped(tmp_path):
    loose = grow(load_scene(scene(tmp_path, fixed="false")).sample(0), 0)
    fixed = grow(load_scene(scene(tmp_path, fixed="true")).sample(0), 0)
    joint = fixed.region == kinds.JOINT
    assert (fixed.young_modulus[joint][1:] == 1e11).all() and (loose.young_modulus[joint][1:] < 1e11).all()
    np.testing.assert_array_equal(fixed.young_modulus[~joint], loose.young_modulus[~joint])


def test_frames_are_resolved_until_a_nanometre_changes_them():
    def touch(torque, converged=True):
        torque = np.repeat(np.array(torque, float)[:, None], 7, axis=1)
        return SimpleNamespace(time=np.arange(len(torque)), torque=torque,
                               converged=np.broadcast_to(converged, len(torque)))

    ours = touch([0.0, 1.0, 2.0, 3.0])
    assert agrees(ours, touch([0.0, 1.0, 2.0, 3.0])).all()
    assert agrees(ours, touch([0.0, 1.1, 2.0, 3.0])).tolist() == [True] * 4
    assert agrees(ours, touch([0.0, 1.2, 2.0, 3.0])).tolist() == [True, False, False, False]
    assert agrees(ours, touch([0.0, 1.0])).tolist() == [True, True, False, False]
    assert agrees(ours, touch([0.0, 1.0, 2.0, 3.0], [True, True, False, True])).tolist() == [True, True, False, False]


def test_an_error_of_another_process_is_read_back_whole():
    """One with a field of its own broke the pool of processes, which then blamed memory."""
    for error in (NothingReached("nothing", "the pot (3)"), Unreachable("too far", Reason.TABLE)):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error) and str(again) == str(error) and vars(again) == vars(error)


def test_the_last_touch_of_a_branch_is_asked():
    protocol = Protocol(shots=(0, 2), query=2, seed=0, folds=2, draws=1, trainings=1, stations=3)
    touches = [SimpleNamespace(converged=np.ones(2, bool), resolved=None, planned_frame=None, press=None)
               for _ in range(9)]
    view = SimpleNamespace(name="plant", object_index=0, view_index=0, touches=touches)
    draw = divide(view, protocol)
    assert set(draw.query) < {2, 5, 8} and draw.pool == (0, 1, 3, 4, 6, 7)
    with pytest.raises(TaskError, match="the last of their branch"):
        divide(view, dataclasses.replace(protocol, query=4))


def test_a_dataset_marks_what_flips_and_an_arm_that_sees_no_branch_is_told(tmp_path):
    vsfsim.generate(scene(tmp_path, width=240, height=216), out=tmp_path / "data", objects=1, touches=3, seed=0)
    (view,) = [Dataset.open(tmp_path / "data").load(entry.name) for entry in Dataset.open(tmp_path / "data").entries]
    assert all(touch.resolved is not None and touch.resolved[0] for touch in view.touches)
    with pytest.raises(SceneError, match="stems and branches"):
        vsfsim.generate(scene(tmp_path, width=240, height=216, distance=1.1, base="[-3.0, 0.0, 0.2]"),
                        out=tmp_path / "none", objects=1, touches=3, seed=0)
