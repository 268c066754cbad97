"""A plants dataset end to end, small: the arm's wrenches, torques, truth, and what a method gets to see."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from texts import changed

from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.scene import parse_scene
from vsfsim.core.shelf import find_scene, find_task
from vsfsim.data.hdf5 import encode_view, read_view
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.subject import prepare_job
from vsfsim.generate.plants.touches import finish_touches, make_together, make_view, solve
from vsfsim.generate.plants.truth import nearest_material_points
from vsfsim.generate.recipe import make_recipe


@pytest.fixture(scope="module")
def scene_file():
    path = find_scene("plants-mini")
    return parse_scene(changed(path.read_text(), ('species = { choice', 'species = "rubber-plant" #'), max_segments=50,
                               frames="{ free = 5, in = 14, hold = 1, out = 4 }", width=120, height=108), path)


@pytest.fixture(scope="module")
def made(scene_file, tmp_path_factory):
    """One object view of three touches, through the file, and its job."""
    recipe = make_recipe(scene_file, seed=2, objects=2, views=2, touches=2)
    path = tmp_path_factory.mktemp("plants") / "view"
    job = jobs_of(recipe, scene_file.path, path.parent)[1]
    view = make_view(job, device="cpu")
    path.write_bytes(encode_view(view))
    return read_view(path), view, job


@pytest.fixture(scope="module")
def prepared(made):
    """The plant, the arm and the planned touches of `made`'s job."""
    return prepare_job(made[2], device="cpu")


def test_the_file_holds_what_was_made(made):
    there, view, _ = made
    assert there.probe == view.probe and there.name.endswith("0000-v1") and len(there.touches) == 2
    for a, b in zip(there.touches, view.touches, strict=True):
        for field in dataclasses.fields(a):
            x, y = getattr(a, field.name), getattr(b, field.name)
            if isinstance(y, np.ndarray):
                assert np.array_equal(x, y, equal_nan=y.dtype.kind == "f"), field.name
        assert a.q.shape == a.torque.shape == (len(a.time), 7)
        assert a.link_force.shape == (len(a.time), 8, 3) and a.draws >= 1
        assert np.allclose(a.link_force.sum(axis=1), a.force, atol=1e-12, equal_nan=True)
    assert any(t.touched for t in there.touches)


@pytest.mark.slow
def test_a_touch_ends_before_its_force_limit_on_the_straight_line(scene_file, tmp_path):
    """With a limit of 3 N: at least one touch is short, no reading is past it, and the tool stays on its line."""
    text = scene_file.text.replace("force_limit = 40.0", "force_limit = 3.0")
    recipe = make_recipe(parse_scene(text, scene_file.path), seed=2, objects=1, views=1, touches=3)
    job = jobs_of(recipe, scene_file.path, tmp_path)[0]
    subject, short = prepare_job(job, device="cpu"), 0
    for touch, a in zip(finish_touches(subject, solve([subject], device="cpu")), subject.aims, strict=True):
        assert np.linalg.norm(touch.force[touch.converged], axis=1).max() <= 3.0
        off = touch.mount_pose[:, :3, 3] - a.target
        assert np.linalg.norm(off - (off @ a.axis)[:, None] * a.axis, axis=1).max() <= 1e-5, "as `straight_touch` says"
        short += len(touch.time) < len(a.plan)
    assert short > 0


def test_the_same_job_gives_the_same_bits_and_another_view_another_turn(made, prepared):
    _, view, job = made
    fewer = dataclasses.replace(job, recipe=dataclasses.replace(job.recipe, touches=1))
    subject = prepare_job(fewer, device="cpu")
    (again,) = finish_touches(subject, solve([subject], device="cpu"))
    assert np.array_equal(view.touches[0].torque, again.torque, equal_nan=True), "its touch is the first of more"
    other = prepare_job(dataclasses.replace(fewer, view_index=0, name="other"), device="cpu")
    # two views: half a turn
    assert np.allclose(other.plant.nodes, prepared.plant.nodes * [-1.0, -1.0, 1.0])
    assert (other.view.camera_pose == prepared.view.camera_pose).all()


def test_truth_of_a_plant(made, prepared):
    truth, plant = made[0].truth, prepared.plant
    assert (truth.young_modulus == plant.young_modulus[1:]).all() and (truth.radius == plant.radius[1:]).all()
    assert truth.segment_ends.shape == (len(plant.nodes) - 1, 2, 3) and set(np.unique(truth.region)) <= set(range(4))
    assert (len(truth.probe_points) > 5 and (truth.probe_stiffness > 0).all()
            and np.isfinite(truth.probe_stiffness).all())
    leaf = truth.region == 3
    # a leaf is soft, a stem is not: the stiffness at visible points must tell them apart
    segment, *_ = nearest_material_points(prepared.model, truth.probe_points)
    on_leaf = leaf[segment - 1]
    assert on_leaf.any() and (~on_leaf).any()
    assert np.median(truth.probe_stiffness[on_leaf]) < np.median(truth.probe_stiffness[~on_leaf])
    assert truth.vsf_stiffness.shape == (len(truth.vsf_points),) and (truth.vsf_stiffness >= 0).all()


def test_a_task_reads_torques_with_the_noise_of_their_sensors(made):
    view, *_ = made
    path = find_task("fewshot-plants-v5-mini-v1")
    white = path.read_text().replace('kind = "gen3-posed"', "force_std = 0.0\ntorque_std = 0.1")
    task = parse_task(white, path)
    protocol = dataclasses.replace(task.protocol, folds=0, draws=0, trainings=0, seeds=1)  # no planned paths
    task = dataclasses.replace(task, protocol=protocol)
    recording = record(view, task)
    for touch, reading, clean in zip(view.touches, recording.readings, recording.clean, strict=True):
        assert reading.value.shape == (len(touch.time), 7) and reading.action.size == 7
        assert (reading.action.q == touch.q).all()
        assert np.array_equal(clean[touch.converged], touch.torque[touch.converged])
        error = (reading.value - clean)[touch.converged]
        # white noise of 0.1 N m, and the tare's own error; of 240 touches the spread is 0.080 to 0.129 N m, on joints 5
        # to 7, whose noise is half as large, 0.039 to 0.070 N m
        assert 0.07 < error[:, :4].std() < 0.14 and 0.035 < error[:, 4:].std() < 0.075
        assert np.abs(reading.value[:5].mean(axis=0)).max() < 1e-9  # tared on the five frames before contact
    bare = dataclasses.replace(view, touches=tuple(dataclasses.replace(t, torque=None) for t in view.touches))
    with pytest.raises(Exception, match="no joint torques"):
        record(bare, task)


@pytest.mark.slow
def test_views_solved_together_by_many_processes_are_the_same_bits(scene_file, tmp_path, device):
    """The way of a GPU: prepared and finished by other processes, solved in one batch."""
    recipe = make_recipe(scene_file, seed=2, objects=2, views=1, touches=2, device=device)
    jobs = jobs_of(recipe, scene_file.path, tmp_path)
    assert {*make_together(jobs, device=device, workers=2)} == {job.name for job in jobs}
    for job in jobs:
        together, alone = read_view(next(tmp_path.rglob(f"{job.name}*"))), make_view(job, device=device)
        assert all(np.array_equal(a.torque, b.torque, equal_nan=True) and np.array_equal(a.target, b.target)
                   for a, b in zip(together.touches, alone.touches, strict=True))
