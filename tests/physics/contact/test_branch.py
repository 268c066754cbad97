"""States that let a body through are barred: where the body does work, and only there."""

import numpy as np
import pytest

from vsfsim.core.shape import Sphere
from vsfsim.physics.solve import branch
from vsfsim.physics.solve.touches import Solver


def at(depth):
    pose = np.tile(np.eye(4), (1, 1, 1, 1))
    pose[0, 0, :3, 3] = [0.003, 0.001, 0.045 - depth]
    return pose


@pytest.fixture
def press(block, device):
    """A solver's one touch, 3 mm deep in equilibrium, and its potential there [J]."""
    def pressed(friction=0.0):
        solver = Solver(block((0.06, 0.06, 0.03), 0.015), Sphere(0.015), device=device, friction=friction)
        assert solver.run(np.stack([at(0.0015), at(0.003)])).converged.all()
        return solver._balance, float(solver._balance.evaluate(solver._balance.every)["potential"][0])

    return pressed


def test_a_body_that_moves_inward_bars_states_of_less_potential(press):
    balance, potential = press()
    branch.bar(balance, balance.every, at(0.003), at(0.004))
    assert balance.least[0].item() == potential > 0.0
    branch.lift(balance, balance.every)
    assert balance.least[0].item() == -np.inf


def test_a_body_that_retreats_or_slides_bars_nothing(press):
    balance, _ = press()
    for to in (at(0.002), at(0.003) + np.pad([[0.002]], ((0, 3), (3, 0)))):
        balance.least[:] = 1.0
        branch.bar(balance, balance.every, at(0.003), to)
        assert balance.least[0].item() == -np.inf


def test_with_friction_nothing_is_barred(press):
    balance, _ = press(friction=0.5)
    branch.bar(balance, balance.every, at(0.003), at(0.004))
    assert balance.least[0].item() == -np.inf
