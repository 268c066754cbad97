"""A bubble pressed on soft things: one equilibrium of both, forces that balance, and the rigid limit."""

import dataclasses

import numpy as np
import pytest
from texts import scene

from vsfsim.core.bubble import Bubble
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.solve.coupled import CoupledSolver, free_way


@pytest.fixture(scope="module")
def bubble():
    return build_bubble(Bubble(nodes=200))


@pytest.fixture
def block():
    return lambda modulus: tiers.build(scene("block", shape="{ box = [0.10, 0.10, 0.04] }", resolution=0.02, press=None,
                                             young_modulus=modulus).sample(0), "fem-coarse")


def down(height, depths, x=0.004, y=0.003):
    """Poses (T, 1, 4, 4) of a sensor that looks down at a top 40 mm high, its apex ``depths`` below it."""
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(depths), 1, 1, 1))
    poses[:, 0, :3, 3] = [(x, y, 0.04 + height - depth) for depth in depths]
    return poses


def press(model, bubble, depths, friction, device, **limits):
    solver = CoupledSolver(model, bubble, friction=friction, device=device,
                           options=dataclasses.replace(tiers.options("fem"), **limits))
    frames = solver.run(down(bubble.mesh.points[:, 2].max(), depths), keep=True)
    return solver, frames


def test_both_bodies_balance_and_the_gas_is_squeezed(bubble, block, device):
    solver, frames = press(block(1e5), bubble, [0.001, 0.003], 2.0, device)
    assert frames.converged.all()
    force = frames.force[:, 0]
    assert (np.diff(force[:, 2]) > 0.0).all(), "the object pushes the sensor up, the more the deeper"
    # what the object's support carries is what the sensor feels, and what its nodes feel adds up to it
    assert np.abs(frames.reaction[:, 0] - force).max() < 1e-3 * force[-1, 2]
    assert np.allclose(np.stack(solver.sensor_force)[..., 0].sum(axis=1), force, atol=1e-9)
    assert (np.diff(np.stack(solver.pressure)[:, 0]) > 0.0).all()
    law = (np.stack(solver.pressure)[:, 0] + 101325.0) * (np.stack(solver.volume)[:, 0] + bubble.dead_volume) ** 1.4
    assert np.ptp(law) < 1e-6 * law[0]
    # 1 % of an element
    assert frames.penetration.max() < 0.01 * bubble.element_size


def test_a_stiff_block_is_a_rigid_plane(bubble, block, device):
    from vsfsim.core.shape import Plane
    from vsfsim.physics.solve.touches import Solver

    depths = [0.002, 0.004]
    _, soft = press(block(1e9), bubble, depths, 0.0, device)
    plane = down(bubble.mesh.points[:, 2].max() - 0.04, depths)  # in the mount frame it looks down at the dome
    rigid = Solver(bubble, Plane(), device=device, options=tiers.options("fem")).run(plane)
    assert soft.converged.all() and rigid.converged.all()
    # nodes here, Gauss points there: half a per cent of the mesh's own error of some per cent
    assert np.allclose(soft.force[:, 0, 2], rigid.body_force[:, 0, 0, 2], rtol=0.03)


def test_a_batch_gives_what_its_touches_give_alone(bubble, block, device):
    """The second one is approached in halves, alone: it meets what is there where it is, and what the first one met and
    stuck to stays as it was."""
    ways = np.concatenate([down(bubble.mesh.points[:, 2].max(), [-0.001, deep], x) for x, deep in (
        (0.004, 0.002), (-0.03, 0.006))], axis=1)
    solver = CoupledSolver(block(1e5), bubble, friction=1.0, device=device,
                           options=dataclasses.replace(tiers.options("fem-coarse"), newton=5, halvings=1))
    both, alone = solver.run(ways), [solver.run(ways[:, k:k + 1]) for k in range(2)]
    assert both.converged.all()
    for k, own in enumerate(alone):
        assert np.allclose(both.force[:, k], own.force[:, 0], atol=2e-3 * own.force[1, 0, 2])


@pytest.mark.slow
def test_what_comes_nearer_than_is_looked_for_is_met_late(bubble, block, device, monkeypatch):
    """Rubber of 1 kPa bulges towards the skin by more than 0.6 mm in a step: what is met there is found in equilibrium,
    and the touch is solved again with it."""
    known = press(block(1e3), bubble, [0.004], 0.0, device)[1].force[0, 0, 2]
    monkeypatch.setattr("vsfsim.physics.solve.coupled._MARGIN", 0.02)
    late = press(block(1e3), bubble, [0.004], 0.0, device)[1].force[0, 0, 2]
    assert late == pytest.approx(known, rel=0.01)  # 0.6 % less; with no second solution none


def test_the_way_to_first_contact(bubble, block):
    pose = down(bubble.mesh.points[:, 2].max(), [-0.007])[0, 0]
    assert free_way(block(1e5), bubble, pose, np.array([0.0, 0.0, -1.0])) == pytest.approx(0.007, abs=1e-9)
    pose[0, 3] = 1.0
    assert free_way(block(1e5), bubble, pose, np.array([0.0, 0.0, -1.0])) == np.inf


@pytest.mark.slow
def test_a_slack_skin_is_felt_or_its_frames_are_marked(block, device):
    """At 1 Pa the dome is 5 um high: its height says nothing about how far it moves, and a block that it enters by
    millimetres may not be missed."""
    sensor = build_bubble(Bubble(nodes=100, gauge_pressure=1.0))
    assert np.ptp(sensor.mesh.points[:, 2]) < 2e-5
    solver = CoupledSolver(block(1e3), sensor, device=device, options=dataclasses.replace(
        tiers.options("fem-coarse"), seconds=1e9, cg_frame=20, newton_frame=4))
    frames = solver.run(down(0.0, (-0.002, 0.002, 0.004), 0.003, 0.002))
    pushed = np.nan_to_num(np.linalg.norm(frames.force[:, 0], axis=1))
    assert frames.converged[0, 0] and pushed[0] == 0.0
    assert ((pushed[1:] > 0.0) | ~frames.converged[1:, 0]).all()
