"""States that let a body through are barred, and equilibria to which an object snapped are marked: where the body does
work, and only there."""

import itertools

import numpy as np
import pytest
from frame_checks import from_above

from vsfsim.core.shape import Box, Sphere
from vsfsim.physics.solve.frames import Reason
from vsfsim.physics.solve.solution_branch import SolutionBranch
from vsfsim.physics.solve.touches import Solver


def at(depth):
    pose = np.tile(np.eye(4), (1, 1, 1, 1))
    pose[0, 0, :3, 3] = [0.003, 0.001, 0.045 - depth]
    return pose


@pytest.fixture
def press(block, device):
    """A solver whose one touch is 3 mm deep in equilibrium, and 4 mm deep where asked."""
    def pressed(friction=0.0, *more):
        solver = Solver(block((0.06, 0.06, 0.03), 0.015), Sphere(0.015), device=device, friction=friction)
        assert solver.run(np.stack([at(d) for d in (0.0015, 0.003, *more)])).converged.all()
        return solver._branch, solver._balance

    return pressed


def test_a_body_that_moves_inward_bars_states_of_less_potential(press):
    branch, balance = press()
    potential = float(balance.evaluate(balance.every)["potential"][0])
    branch.bar(balance.every, at(0.003), at(0.004))
    assert balance.least[0].item() == potential > 0.0
    branch.lift(balance.every)
    assert balance.least[0].item() == -np.inf


def test_a_body_that_retreats_or_slides_bars_nothing(press):
    branch, balance = press()
    for to in (at(0.002), at(0.003) + np.pad([[0.002]], ((0, 3), (3, 0)))):
        balance.least[:] = 1.0
        branch.bar(balance.every, at(0.003), to)
        assert balance.least[0].item() == -np.inf


def test_with_friction_nothing_is_barred(press):
    branch, balance = press(0.5)
    branch.bar(balance.every, at(0.003), at(0.004))
    assert balance.least[0].item() == -np.inf


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_an_equilibrium_that_misses_the_work_of_the_body_is_marked(press, friction):
    """5 % of the energy may be missing; the work from 3 to 4 mm is over half of it."""
    branch, balance = press(friction, 0.004)
    equilibrium = balance.u.clone()
    before = press(friction)[1].u
    for u, reason in ((equilibrium, Reason.NONE), (0.98 * equilibrium, Reason.NONE), (before, Reason.SNAPPED)):
        balance.u.copy_(before)
        branch.begin()
        branch.bar(balance.every, at(0.003), at(0.004))
        balance.u.copy_(equilibrium)  # its forces are the body's at the end of the step
        balance.contact.move(at(0.004), balance.every)
        balance.evaluate(balance.every)
        balance.u.copy_(u)
        balance.elasticity.forces(*columns(balance))
        balance.reason[:] = Reason.NONE
        branch.mark(balance.every, at(0.004), last=True)
        assert balance.reason[0] == reason


@pytest.mark.parametrize(("scale", "doubtful"), [(1.0, False), (0.99, True)])
def test_a_step_that_misses_a_little_energy_is_made_again_in_shorter_ones(press, scale, doubtful):
    """2 % of the energy is less than a snap, but more than the force's bend along the step explains."""
    branch, balance = press(0.0, 0.004)
    balance.u *= scale
    balance.elasticity.forces(*columns(balance))
    for last in (True, False):
        balance.reason[:] = Reason.NONE
        branch.mark(balance.every, at(0.004), last=last)
        assert (balance.reason[0] == Reason.SNAPPED) == (doubtful and not last)


@pytest.mark.parametrize(("other", "again"), [(1.0, False), (0.997, True)])
def test_what_shorter_steps_find_again_is_not_doubted(press, other, again):
    """The doubt was that the long step went elsewhere; another energy at the same pose is doubted as before."""
    branch, balance = press(0.0, 0.004)
    end, elsewhere = at(0.004), at(0.0035)
    for scale, pose, doubted in ((0.99, end, True), (0.99, elsewhere, True), (0.99 * other, end, again)):
        balance.u *= scale
        balance.elasticity.forces(*columns(balance))
        balance.u /= scale
        balance.reason[:] = Reason.NONE
        branch.mark(balance.every, pose, last=False)
        assert (balance.reason[0] == Reason.SNAPPED) == doubted


def columns(balance):
    """The arguments of `Elasticity.forces` for all touches."""
    import torch
    import warp as wp

    return wp.from_torch(balance.every.to(torch.int32)), wp.from_torch(balance.u)


def test_a_body_that_turns_is_not_asked_for_its_work(press):
    """Its moments do work, too."""
    branch, balance = press()
    turned = at(0.004)
    turned[0, 0, :3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    branch.begin()
    branch.bar(balance.every, at(0.003), turned)
    balance.u.zero_()
    balance.elasticity.forces(*columns(balance))
    balance.reason[:] = Reason.NONE
    branch.mark(balance.every, turned, last=True)
    assert balance.reason[0] == Reason.NONE


def test_a_column_that_buckles_under_friction_is_not_called_converged(block, device):
    """A ball that sticks on a slender column: past the load of buckling it falls aside, and all but a fortieth of the
    energy is gone. Cell bce3e6928d02 of the stability map did so without a mark."""
    depths = (0.01, 0.015, 0.02)
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, 2, 3] = 0.108 - np.array(depths)
    solver = Solver(block((0.02, 0.02, 0.1), 0.02, poisson_ratio=0.3), Sphere(0.008), friction=1.0, device=device)
    frames = solver.run(poses, start=from_above(poses))
    push, energy, kept = frames.force[:, 0, 2], frames.energy[:, 0], np.flatnonzero(frames.converged[:, 0])
    assert 0 in kept  # how far the straight column goes depends on rounding
    for before, now in itertools.pairwise(kept):
        work = min(push[before], push[now]) * (depths[now] - depths[before])
        assert energy[now] > energy[before] + 0.9 * work


def test_half_a_step_begins_in_equilibrium_with_the_points_of_the_failed_one(block, device, monkeypatch):
    """A step that failed has met points of the box's edges where the object was then. Where the step begins they lay
    inside the object, so that the state there had four fifths of its force too much and barred the true equilibria."""
    bar, mark, unbalanced, marked = SolutionBranch.bar, SolutionBranch.mark, [], []

    def barred(self, columns, before, pose):
        bar(self, columns, before, pose)
        unbalanced.append(float(self._balance.evaluate(columns)["measure"].max()))

    def fails_once(self, columns, pose, *, last):
        mark(self, columns, pose, last=last)
        marked.append(columns)
        if len(marked) == 2:
            self._balance.reason[:] = Reason.SNAPPED

    monkeypatch.setattr(SolutionBranch, "bar", barred)
    monkeypatch.setattr(SolutionBranch, "mark", fails_once)
    poses = np.tile(np.eye(4), (2, 1, 1, 1))
    poses[:, 0, 2, 3] = 0.046 - np.array([0.003, 0.006])
    model = block((0.04, 0.04, 0.04), 0.015, poisson_ratio=0.499)
    frames = Solver(model, Box((0.012,) * 3), device=device).run(poses, start=from_above(poses))
    assert frames.converged.all() and len(marked) > 3
    assert max(unbalanced) < 1e-3
