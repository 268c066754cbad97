"""The arm's capsules are rigid bodies for the solver: same surfaces, and contact that ends up on the right link."""

import numpy as np
import pytest

from vsfsim.core.rotation import rotation_matrix
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.arm import Arm
from vsfsim.robot.reach import straight_touch


def test_the_arm_presses_a_block_with_its_wrist(block, device):
    """The forearm comes from the side: the force is on the links that reach the block, and its reaction on the block's
    ground."""
    model = block((0.1, 0.1, 0.2), 0.05, poisson_ratio=0.4)
    base = np.eye(4)
    base[:3, 3] = [-0.42, 0.33, 0.0]
    arm = Arm(base=base)
    q = straight_touch(arm, [0.14, 0.13, 0.17], [0.14, 0.086, 0.17], rotation_matrix((0.0, np.pi / 2, 0.0)),
                       frames=12)[[0, 10, 11]]
    frames = Solver(model, arm.shapes, device=device).run(arm.body_poses(q)[:, None])
    assert frames.converged.all()
    force = frames.body_force[:, 0]
    wrist = [arm.links[n].startswith("spherical_wrist") or arm.links[n] == "forearm_link" for n in arm.capsule_links]
    assert (force[0] == 0.0).all() and (force[:, np.logical_not(wrist)] == 0.0).all()
    assert force[-1].sum(axis=0)[1] > 1.0, "the block pushes the arm back along y"
    assert force.sum(axis=1) == pytest.approx(frames.force[:, 0], abs=1e-9)
