"""J^T f: against MuJoCo's Jacobians, its inverse dynamics, and the work that the forces do."""

import mujoco
import numpy as np
import pytest

from vsfsim.robot.arm import ArmError, load_arm
from vsfsim.robot.joint_torque import body_torque, contact_rows, jacobian


@pytest.fixture(scope="module")
def arm():
    return load_arm(punyo=True)


@pytest.fixture(scope="module")
def case(arm):
    rng = np.random.default_rng(7)
    shape = (6, len(arm.shapes), 3)
    return rng.uniform(-2.0, 2.0, (6, 7)), 10.0 * rng.normal(size=shape), rng.normal(size=shape)


def body(arm, k):
    return arm.model.body(arm.capsules[k].link).id


def test_torques_are_those_of_mujocos_inverse_dynamics(arm, case):
    """The acceleration that forces on the bodies bring is put into mj_inverse: it asks for J^T f at the joints,
    friction aside."""
    q, force, moment = case
    got, poses = body_torque(arm, q, force, moment=moment), arm.body_poses(q)
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


def test_rows_are_mujocos_jacobians(arm, case):
    q, force, _ = case
    data, poses = mujoco.MjData(arm.model), arm.body_poses(q)
    points = poses[..., :3, 3] + 0.03
    rows, j = contact_rows(arm, q, arm.capsule_links, points, force), jacobian(arm, q, arm.capsule_links, points)
    for t in range(len(q)):
        data.qpos[:] = q[t]
        mujoco.mj_forward(arm.model, data)
        for k in range(len(arm.shapes)):
            want = np.zeros((3, 7))
            mujoco.mj_jac(arm.model, data, want, None, points[t, k], body(arm, k))
            assert j[t, k] == pytest.approx(want, abs=1e-12)
            assert rows[t, k] == pytest.approx(want.T @ force[t, k], abs=1e-11)
    assert rows.sum(axis=1) == pytest.approx(body_torque(arm, q, force, point=points), abs=1e-10)


def test_what_does_not_fit_is_refused(arm, case):
    q, force, moment = case
    with pytest.raises(ArmError, match="moments about"):
        body_torque(arm, q, force)
    with pytest.raises(ArmError, match="force has the shape"):
        body_torque(arm, q, force[:, :3], moment=moment)
    bad = force.copy()
    bad[2, 4, 1] = np.nan
    with pytest.raises(ArmError, match="frame 2 is not finite"):
        body_torque(arm, q, bad, moment=moment)
    with pytest.raises(ArmError, match="contact on link 12"):
        contact_rows(arm, q, np.full(3, 12), force[:, :3], force[:, :3])
