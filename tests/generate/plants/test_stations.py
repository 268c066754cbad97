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
from vsfsim.generate.plants.aim import APART, SPAN, NothingReached, visible_branches
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


def test_points_of_a_branch_have_their_places_along_it(tmp_path):
    """The visible points of a branch and their places, few of another branch."""
    plant = grow(load_scene(scene(tmp_path)).sample(0), 0)
    rng, points, owner = np.random.default_rng(0), [], []
    for i in range(1, len(plant.nodes)):
        share = rng.uniform(size=(20, 1))
        a = plant.nodes[plant.parent[i]]
        points.append(a + share * (plant.nodes[i] - a))
        owner += [plant.look[i]] * 20
    cloud, owner = np.concatenate(points), np.array(owner)
    branches = visible_branches(plant, cloud)
    assert branches
    for points, at in branches:
        own = np.array([owner[np.flatnonzero((cloud == point).all(axis=1))[0]] for point in points])
        mine = own == np.bincount(own).argmax()
        assert mine.mean() > 0.7  # where axes join, either may be nearer
        order = np.argsort(at[mine])
        steps = np.linalg.norm(np.diff(points[mine][order], axis=0), axis=1)
        np.testing.assert_allclose(steps, np.diff(at[mine][order]), atol=0.003)  # straight but for its bends
        assert np.ptp(at) >= SPAN
    assert visible_branches(plant, plant.nodes[:1]) == []


def test_three_touches_in_turn_share_a_branch_and_any_may_be_drawn_alone(tmp_path):
    from vsfsim.generate.job import jobs_of
    from vsfsim.generate.plants.subject import prepare_job
    from vsfsim.generate.recipe import make_recipe

    loaded = load_scene(scene(tmp_path, width=240, height=216))
    recipe = make_recipe(loaded, seed=0, objects=1, views=1, touches=6)
    subject = prepare_job(jobs_of(recipe, loaded.path, tmp_path)[0], device="cpu")
    assert len(subject.aims) == 6
    targets = [aim.target for aim in subject.aims]
    branches = visible_branches(subject.plant, snapped(subject.view.points()))
    for group in (targets[:3], targets[3:]):
        (places,) = [at[[(points == target).all(axis=1).argmax() for target in group]] for points, at in branches
                     if all((points == target).all(axis=1).any() for target in group)]
        assert (np.diff(np.sort(places)) >= APART).all()


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


def test_a_dataset_marks_what_flips(tmp_path):
    vsfsim.generate(scene(tmp_path, width=240, height=216), out=tmp_path / "data", objects=1, touches=3, seed=0)
    (view,) = [Dataset.open(tmp_path / "data").load(entry.name) for entry in Dataset.open(tmp_path / "data").entries]
    assert all(touch.resolved is not None and touch.resolved[0] for touch in view.touches)


def test_an_arm_that_reaches_no_branch_is_told(tmp_path, monkeypatch):
    from vsfsim.generate.job import jobs_of
    from vsfsim.generate.plants.subject import prepare_job
    from vsfsim.generate.recipe import make_recipe

    monkeypatch.setattr("vsfsim.generate.plants.aim.DRAWS", 10)
    monkeypatch.setattr("vsfsim.generate.plants.aim.ON_BRANCH", 10)
    loaded = load_scene(scene(tmp_path, width=240, height=216, base="[-3.0, 0.0, 0.2]"))
    recipe = make_recipe(loaded, seed=0, objects=1, views=1, touches=3)
    with pytest.raises(SceneError, match="stem or branch"):
        prepare_job(jobs_of(recipe, loaded.path, tmp_path)[0], device="cpu")
