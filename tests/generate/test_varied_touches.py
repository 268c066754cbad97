"""Touches that differ in tilt, depth and start, and a probe that a spring carries."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from texts import scene

from vsfsim.generate.effectors.probe import EFFECTOR
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.physics import tiers
from vsfsim.physics.mesh.resolved import LIMIT
from vsfsim.physics.solve.touches import Solver

SPRING = 800.0


def _job(*pairs, **values):
    recipe = make_recipe(scene("varied", *pairs, **values), objects=1)
    return jobs_of(recipe, Path("varied.toml"), Path())[0]


@pytest.fixture(scope="module")
def made():
    job = _job()
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
    model = prepare(job, device="cpu").model
    poses = np.stack([t.mount_pose for t in view.touches], axis=1)
    force = np.stack([t.force for t in view.touches], axis=1)
    axis = np.stack([t.axis for t in view.touches])
    given = -(force * axis).sum(axis=2) / SPRING
    assert given.max() > 5e-4, "the spring takes a part of the travel that counts"
    poses[..., :3, 3] -= given[..., None] * axis
    # a rigid mount that leads the probe to where the spring let it go meets the same force
    alone = Solver(model, job.scene().probe, options=tiers.options("linear"), linear=True).run(poses)
    assert alone.converged.all() and np.abs(alone.force - force).max() < 1e-3 * np.abs(force).max()
    told = np.stack([t.audit["mesh_error"] for t in view.touches], axis=1)
    assert told == pytest.approx(alone.mesh_error, rel=5e-3) and alone.law_error.max() > 1e-3


def test_the_mount_goes_as_planned(made):
    _, view = made
    for touch in view.touches:
        way = np.diff(touch.mount_pose[1:, :3, 3] @ touch.axis)
        assert way == pytest.approx(np.full(len(way), way.mean()), rel=1e-9)
        assert touch.mount_stiffness == SPRING
        gone = (touch.mount_pose - touch.probe_pose())[:, :3, 3] @ touch.axis
        assert gone == pytest.approx(touch.normal_force() / SPRING, abs=1e-12)


def test_a_contact_that_is_noticed_late_is_a_deeper_press_than_recorded():
    subject = prepare(_job(("tilt =", "late_range = [0.001, 0.002]\ntilt =")), device="cpu")
    aims = EFFECTOR.aim(subject, device="cpu")
    assert all(0.001 <= a.late <= 0.002 for a in aims) and aims[0].late != aims[1].late
    deeper = [dataclasses.replace(a, contact=a.contact + a.late * a.axis, late=0.0) for a in aims]
    both = [EFFECTOR.touch(subject, some, device="cpu") for some in (aims, deeper)]
    for a, late, real in zip(aims, *both, strict=True):
        assert late.force == pytest.approx(real.force, abs=1e-9) and late.normal_force()[1] > 0.1
        off = (real.mount_pose - late.mount_pose)[:, :3, 3]
        assert off == pytest.approx(np.tile(a.late * a.axis, (len(off), 1)), abs=1e-12)


@pytest.mark.slow
def test_elements_of_each_touch_are_small_where_it_meets_the_object():
    # small strain is off by more than the mesh, as elements turn inside out
    rigid = {"mount_stiffness": None, "tier": '"fem-coarse"'}
    for edge, resolves in ("", False), ("contact_edge = 0.8\n", True):
        small = (("sphere = 0.015", "sphere = 0.006"), ("tilt =", f"{edge}tilt ="), ("count = 4", "count = 2"),
                 ("in = 3", "in = 2"))
        for touch in EFFECTOR.make_view(_job(*small, **rigid), device="cpu").touches:
            assert (touch.audit["mesh_error"].max() <= LIMIT) == resolves and touch.converged.all()
