"""What a step begins from where the condensed problem, in which the body responds as at rest, leads astray."""

import numpy as np
import pytest
import torch

from vsfsim.core.shape import Sphere
from vsfsim.physics.solve import step
from vsfsim.physics.solve.prediction import guesses, predict
from vsfsim.physics.solve.touches import Solver


def down(height, depths):
    """Poses (T, 1, 4, 4) of a body whose frame is so high above the bottom of the object."""
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, :3, 3] = [[0.003, 0.001, height - d] for d in depths]
    return poses


@pytest.fixture
def pressed(block, device):
    """A ball's press with its last equilibrium, and the equilibria before it."""
    solver = Solver(block((0.06, 0.06, 0.03), 0.015), Sphere(0.015), device=device)
    assert solver.run(down(0.045, [0.001, 0.002, 0.003])).converged.all()
    return solver


def led_astray(monkeypatch, contact):
    """Let condensed problems answer nonsense, and say so."""
    def condensed(columns, base, pushed, **_):
        return 1e3 + 0.0 * pushed, torch.ones(len(columns), dtype=torch.float64, device=pushed.device)

    monkeypatch.setattr(contact, "condensed", condensed)


def next_pose(solver):
    pose = down(0.045, [0.004])[:, :, None][0]
    balance, known = solver._balance, solver._equilibria
    solver.contact.begin_step(known[-1].pose, balance.u)
    solver.contact.move(pose, balance.every)
    return pose


def test_an_extrapolation_is_taken_as_it_is_where_its_correction_leads_astray(pressed, monkeypatch):
    balance, contact, known = pressed._balance, pressed.contact, pressed._equilibria
    pose = next_pose(pressed)
    led_astray(monkeypatch, contact)
    offered = guesses(known, (balance.u.clone(), contact.gather(known[-1].force)), pose, contact)
    predict(balance, balance.every, offered)
    assert torch.equal(balance.u, offered[1][0])
    # not the state where the step begins, which the ball now overlaps by a millimetre
    begun = float(balance.evaluate(balance.every)["potential"])
    balance.u.copy_(offered[0][0])
    assert begun < 0.5 * float(balance.evaluate(balance.every)["potential"])


def test_after_one_equilibrium_a_multiple_of_it_is_tried(pressed, monkeypatch):
    """The second frame of a press has nothing to extrapolate from."""
    balance, contact, known = pressed._balance, pressed.contact, pressed._equilibria
    pose, present = next_pose(pressed), balance.u.clone()
    led_astray(monkeypatch, contact)
    predict(balance, balance.every, guesses(known[-1:], (present, contact.gather(known[-1].force)), pose, contact))
    assert any(torch.allclose(balance.u, times * present, rtol=1e-12, atol=0.0) for times in (1.5, 2.0, 3.0))


def test_a_looser_correction_on_large_patches_leads_to_the_same_equilibrium(block, device, monkeypatch):
    def forces():
        frames = Solver(block((0.06, 0.06, 0.03), 0.015), Sphere(0.015), device=device).run(
            down(0.045, [0.002, 0.006, 0.01]))
        assert frames.converged.all()
        return np.linalg.norm(frames.force.reshape(3, -1), axis=1)

    small = forces()
    monkeypatch.setattr(step, "_LARGE", 0)
    assert forces() == pytest.approx(small, rel=1e-3)
