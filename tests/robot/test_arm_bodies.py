"""The arm's capsules are rigid bodies for the solver: same surfaces, and contact that ends up on the right link."""

import numpy as np
import pytest

from vsfsim.core.rotation import rotation_matrix
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.arm import load_arm
from vsfsim.robot.gen3 import HOME
from vsfsim.robot.joint_torque import contact_rows
from vsfsim.robot.reach import straight_touch
from vsfsim.vsf.displacements import Displacements
from vsfsim.vsf.observe import joint_torque_rows


def test_the_arm_presses_a_block_with_its_wrist(block, device):
    """The forearm comes from the side: the force is on the links that reach the block, and its reaction on the block's
    ground."""
    model = block((0.1, 0.1, 0.2), 0.05, poisson_ratio=0.4)
    base = np.eye(4)
    base[:3, 3] = [-0.42, 0.33, 0.0]
    arm = load_arm(base=base)
    q = straight_touch(arm, [0.14, 0.13, 0.17], [0.14, 0.086, 0.17], rotation_matrix((0.0, np.pi / 2, 0.0)),
                       frames=12)[[0, 10, 11]]
    frames = Solver(model, arm.shapes, device=device).run(arm.body_poses(q)[:, None])
    assert frames.converged.all()
    force = frames.body_force[:, 0]
    wrist = [arm.links[n].startswith("spherical_wrist") or arm.links[n] == "forearm_link" for n in arm.capsule_links]
    assert (force[0] == 0.0).all() and (force[:, np.logical_not(wrist)] == 0.0).all()
    assert force[-1].sum(axis=0)[1] > 1.0, "the block pushes the arm back along y"
    assert force.sum(axis=1) == pytest.approx(frames.force[:, 0], abs=1e-9)


def test_rows_of_one_link_are_those_of_the_particle_model():
    """SBML eq. 7 twice: here per contact, in `vsf.observe` for a touch on one link, with the joints past it blanked
    out."""
    arm, link = load_arm(), 5
    q = np.array([HOME, np.array(HOME) + 0.1])
    at = arm.postures(q)
    rng = np.random.default_rng(6)
    rest, moved = rng.uniform(0.2, 0.6, (4, 3)), rng.normal(scale=0.01, size=(2, 4, 3))
    axes = at.axes.copy()
    axes[:, link:] = 0.0
    displacements = Displacements(np.array([0, 4, 8]), np.tile(np.arange(4), 2), moved.reshape(-1, 3))
    want = joint_torque_rows(displacements, rest, axes, at.anchors).toarray().reshape(2, 7, 4)
    got = contact_rows(arm, at, np.full(4, link), rest + moved, -moved)
    assert got.transpose(0, 2, 1) == pytest.approx(want, abs=1e-14) and np.abs(want).max() > 1e-4
