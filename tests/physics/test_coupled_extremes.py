"""A bubble on a soft block at the ends of what a scene may ask: every frame converges or says why not, and nothing but
the forces of a frame without an equilibrium is NaN."""

import dataclasses

import numpy as np
import pytest
from frame_checks import numbers_stand_for_equilibria

from vsfsim.core.bubble import Bubble
from vsfsim.core.rotation import rotation_matrix
from vsfsim.core.scene import parse_scene
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Reason

MATCHED = Bubble().modulus / 0.02
"""Young's modulus [Pa] whose block of 20 mm elements is as stiff as the skin: E h = E x 0.02 m."""


def block(modulus, resolution=0.02):
    text = f'''
name = "block"
[object]
shape = {{ box = [0.14, 0.12, 0.05] }}
resolution = {resolution}
poisson_ratio = 0.3
young_modulus = {modulus!r}
'''
    return tiers.build(parse_scene(text, "block.toml").sample(0), "fem-coarse")


def press(body, sensor, depths, *, slant=0.0, device="cpu", friction=2.0):
    """Frames at ``depths`` [m] past the apex' first contact with the top, the mount tilted by ``slant`` [rad] and going
    straight down."""
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_matrix((0.0, slant, 0.0))
    lowest = (sensor.mesh.points @ turn.T)[:, 2].min()
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, :3, :3] = turn
    # off the planes of symmetry, so that nothing cancels
    poses[:, 0, :3, 3] = np.array([0.003, 0.002, 0.05 - lowest]) - np.asarray(depths)[:, None] * [0.0, 0.0, 1.0]
    solver = CoupledSolver(body, sensor, friction=friction, device=device,
                           options=dataclasses.replace(tiers.options("fem-coarse"), seconds=1e9, cg_frame=600))
    frames = solver.run(poses, keep=True)
    good = frames.converged
    assert np.isnan(frames.contact_radius).all(), "two soft bodies have no one element size"
    numbers_stand_for_equilibria(dataclasses.replace(frames, contact_radius=np.zeros_like(frames.contact_radius)))
    for kept in (solver.pressure, solver.volume, solver.sensor_position, solver.sensor_force):
        assert np.isfinite(np.stack(kept)[good[:, 0]]).all()
    assert (good == (frames.reason == Reason.NONE)).all(), "a frame that failed says why, and only that one"
    assert (frames.residual[good] <= 1e-3).all()
    print(f"{int(good.sum())} of {len(depths)} converged, reasons "
          f"{[Reason(int(r)).name for r in frames.reason.ravel()]}, force "
          f"{np.linalg.norm(frames.force[:, 0], axis=1).round(4).tolist()} N, "
          f"{frames.iterations.ravel().tolist()} Newton, {frames.cg_iterations.ravel().tolist()} CG, penetration "
          f"{frames.penetration.max() / sensor.element_size:.1e} of an edge, {frames.seconds.sum():.1f} s")
    return frames


@pytest.fixture(scope="module")
def coarse():
    return build_bubble(Bubble(nodes=200))


@pytest.mark.slow
def test_unloading_comes_back(coarse, device):
    """In, and out over the same depths down to a fifth of a millimetre: with friction the way matters, but where both
    bodies stick it hardly does."""
    depths = [0.001, 0.002, 0.003, 0.004, 0.003, 0.002, 0.001, 0.0002]
    frames = press(block(MATCHED), coarse, depths, device=device)
    assert frames.converged.all()
    force = frames.force[:, 0, 2]
    assert force[4:7] == pytest.approx(force[2::-1], rel=0.05) and 0.0 < force[7] < force[6]


@pytest.mark.slow
def test_the_stiffer_the_block_the_more_it_pushes(coarse, device):
    """Over six decades the force grows from the block's own to that of a wall, and no further."""
    force = [press(block(ratio * MATCHED), coarse, [0.002], device=device).force[-1, 0, 2]
             for ratio in (1e-3, 1e-1, 1.0, 1e1, 1e2, 1e3)]
    gain = np.diff(force)
    # what is missing to a wall is the block's own compliance, a tenth for each decade
    assert (gain > 0.0).all() and gain[-1] < 0.2 * gain[-2] and force[0] < 0.01 * force[-1]


def test_a_slack_skin_is_felt_or_its_frames_are_marked(device):
    """At 1 Pa the dome is 5 um high: its height says nothing about how far it moves, and a block that it enters by
    millimetres may not be missed."""
    sensor = build_bubble(Bubble(nodes=100, gauge_pressure=1.0))
    assert np.ptp(sensor.mesh.points[:, 2]) < 2e-5
    poses = np.tile(np.eye(4), (3, 1, 1, 1))
    poses[:, 0, :3, :3] = np.diag([1.0, -1.0, -1.0])
    poses[:, 0, :3, 3] = [[0.003, 0.002, 0.05 - depth] for depth in (-0.002, 0.002, 0.004)]
    solver = CoupledSolver(block(1e3), sensor, device=device,
                           options=dataclasses.replace(tiers.options("fem-coarse"), seconds=1e9, cg_frame=60,
                                                       newton_frame=12))
    frames = solver.run(poses)
    pushed = np.nan_to_num(np.linalg.norm(frames.force[:, 0], axis=1))
    assert frames.converged[0, 0] and pushed[0] == 0.0
    assert ((pushed[1:] > 0.0) | ~frames.converged[1:, 0]).all()
