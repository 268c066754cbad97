"""Touches that differ in tilt, depth and start, and a probe that a spring carries."""

from pathlib import Path

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.generate.effectors.probe import EFFECTOR
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

SPRING = 800.0
TEXT = """
[object]
shape = { box = [0.08, 0.08, 0.04] }
young_modulus = 1e5
tier = "linear"
resolution = 0.016
[probe]
shape = { sphere = 0.015 }
mount_stiffness = 800.0
[touches]
count = 4
depth_range = [0.003, 0.006]
approach_range = [0.004, 0.02]
tilt = 0.5
frames = { free = 1, in = 3, hold = 0, out = 0 }
[camera]
width = 64
height = 48
"""
PATH = Path("varied.toml")


@pytest.fixture(scope="module")
def made():
    scene = parse_scene(TEXT, PATH)
    job = jobs_of(make_recipe(scene, objects=1), PATH, Path())[0]
    return job, EFFECTOR.make_view(job, device="cpu")


def test_no_two_touches_are_the_same_press(made):
    _, view = made
    touches = view.touches
    tilt = np.array([np.arccos(-t.axis @ t.normal) for t in touches])
    assert len(np.unique(tilt.round(6))) == len(touches) and (tilt < 0.5 + 1e-9).all() and tilt.max() > 0.2
    start = [np.linalg.norm(t.mount_pose[1, :3, 3] - t.mount_pose[0, :3, 3]) for t in touches]
    assert np.ptp(start) > 0.004
    travel = [(t.mount_pose[-1, :3, 3] - t.mount_pose[0, :3, 3]) @ t.axis for t in touches]
    assert len(np.unique(np.round(travel, 6))) == len(touches)


def test_the_spring_is_in_equilibrium_with_the_object(made):
    job, view = made
    scene, model = job.scene(), prepare(job, device="cpu").model
    poses = np.stack([t.mount_pose for t in view.touches], axis=1)
    force = np.stack([t.force for t in view.touches], axis=1)
    axis = np.stack([t.axis for t in view.touches])
    given = -(force * axis).sum(axis=2) / SPRING
    assert given.max() > 5e-4, "the spring takes a part of the travel that counts"
    poses[..., :3, 3] -= given[..., None] * axis
    # a rigid mount that leads the probe to where the spring let it go meets the same force
    alone = Solver(model, scene.probe, options=tiers.options("linear"), linear=True).run(poses)
    assert alone.converged.all()
    assert np.abs(alone.force - force).max() < 1e-3 * np.abs(force).max()


def test_the_mount_goes_as_planned(made):
    _, view = made
    for touch in view.touches:
        way = np.diff(touch.mount_pose[1:, :3, 3] @ touch.axis)
        assert way == pytest.approx(np.full(len(way), way.mean()), rel=1e-9)
        assert touch.mount_stiffness == SPRING
        gone = (touch.mount_pose - touch.probe_pose())[:, :3, 3] @ touch.axis
        assert gone == pytest.approx(touch.normal_force() / SPRING, abs=1e-12)


@pytest.mark.parametrize("old, new, message", [
    ("approach_range = [0.004, 0.02]", "approach_range = [0.02, 0.004]",
     r"approach_range is \[0.02, 0.004\]"), ("approach_range = [0.004, 0.02]",
                                             "approach_range = [0.004, 0.02]\napproach = "
                                             "0.01", "approach gives one value"),
    ("depth_range = [0.003, 0.006]", "depth_range = [0.0, 0.006]", r"it must satisfy 1e-05 <= low"),
    ("mount_stiffness = 800.0", "mount_stiffness = 0.0", "mount_stiffness is 0"),])
def test_mistakes_in_the_scene(old, new, message):
    with pytest.raises(SceneError, match=message):
        parse_scene(TEXT.replace(old, new), PATH)


def test_a_spring_needs_touches():
    text = TEXT.split("[touches]", maxsplit=1)[0] + "[press]\nfrom = [0.0, 0.0, 0.06]\nto = [0.0, 0.0, 0.05]\n"
    with pytest.raises(SceneError, match=r"mount_stiffness is 800.0, but there is no .touches."):
        parse_scene(text, PATH)
