"""J^T f: against MuJoCo's inverse dynamics."""

import mujoco
import numpy as np
import pytest

from vsfsim.robot.arm import Arm, body_torque


@pytest.fixture(scope="module")
def arm():
    return Arm(punyo=True)


def body(arm, k):
    return arm.body_ids[arm.capsule_links[k]]


def test_torques_are_those_of_mujocos_inverse_dynamics(arm):
    """The acceleration that forces on the bodies bring is put into mj_inverse: it asks for J^T f at the joints,
    friction aside."""
    rng, shape = np.random.default_rng(7), (6, len(arm.shapes), 3)
    q, force, moment = rng.uniform(-2.0, 2.0, (6, 7)), 10.0 * rng.normal(size=shape), rng.normal(size=shape)
    got, poses = body_torque(arm, arm.postures(q), force, moment=moment), arm.body_poses(q)
    data = mujoco.MjData(arm.model)
    for t in range(len(q)):
        data.qpos[:], data.qvel[:], data.xfrc_applied[:] = q[t], 0.0, 0.0
        mujoco.mj_kinematics(arm.model, data)
        for k in range(len(arm.shapes)):
            lever = poses[t, k, :3, 3] - data.xipos[body(arm, k)]
            data.xfrc_applied[body(arm, k)] += [*force[t, k], *(moment[t, k] + np.cross(lever, force[t, k]))]
        mujoco.mj_forward(arm.model, data)
        mujoco.mj_inverse(arm.model, data)
        # the constraint solver's friction is iterated to 1e-8 of a model of tens of newton metres
        assert got[t] == pytest.approx(data.qfrc_inverse, abs=1e-6)
    assert np.abs(got).max() > 10.0
