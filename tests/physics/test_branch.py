"""States that let a body through are barred: where the body does work, and only there."""

import numpy as np
import torch
from test_extremes import PROBE, SIZE, body

from vsfsim.physics.solve import branch
from vsfsim.physics.solve.touches import Solver


def at(depth):
    pose = np.tile(np.eye(4), (1, 1, 1, 1))
    pose[0, 0, :3, 3] = [0.003, 0.001, SIZE[2] + 0.015 - depth]
    return pose


def pressed(device, friction=0.0):
    """A solver whose one touch is 3 mm deep in equilibrium, and its potential there [J]."""
    solver = Solver(body(), PROBE, device=device, friction=friction)
    assert solver.run(np.stack([at(0.0015), at(0.003)])).converged.all()
    return solver._balance, float(solver._balance.evaluate(solver._balance.every)["potential"][0])


def test_a_body_that_moves_inward_bars_states_of_less_potential(device):
    balance, potential = pressed(device)
    branch.bar(balance, balance.every, at(0.003), at(0.004))
    assert balance.least[0].item() == potential > 0.0
    branch.lift(balance, balance.every)
    assert balance.least[0].item() == -np.inf


def test_a_body_that_retreats_or_slides_bars_nothing(device):
    balance, _ = pressed(device)
    for to in (at(0.002), at(0.003) + np.pad([[0.002]], ((0, 3), (3, 0)))):
        balance.least[:] = 1.0
        branch.bar(balance, balance.every, at(0.003), to)
        assert balance.least[0].item() == -np.inf


def test_with_friction_nothing_is_barred(device):
    balance, _ = pressed(device, friction=0.5)
    branch.bar(balance, balance.every, at(0.003), at(0.004))
    assert torch.isinf(balance.least).all()
