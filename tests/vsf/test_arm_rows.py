"""Rows of joint torques: against MuJoCo's Jacobians."""

import mujoco
import numpy as np

from vsfsim.bench.inclusions import reached
from vsfsim.robot.arm import Arm, body_torque, chain_of
from vsfsim.vsf.observations import arm_displacements_each, arm_torque_rows_each


def test_rows_of_the_particle_model_are_j_transpose_of_the_springs_forces():
    """SBML eq. 7 in two ways: rows times stiffness, and MuJoCo's Jacobians on forces -K u; every
    particle moves no more than the arm reaches."""
    arm = Arm()
    chain = chain_of(arm)
    rng = np.random.default_rng(1)
    q0 = np.array([0.3, 0.6, 3.0, -2.0, 0.2, 0.9, 1.0])
    q = q0 + np.linspace(0.0, 1.0, 7)[:, None] * np.array([0.15, 0.05, 0.0, 0.1, 0.0, -0.05, 0.2])
    centre = chain.capsule_poses(chain.links(q))[-1, :, :3, 3]
    particles = (centre[rng.integers(5, len(centre), 400)] + rng.normal(0.0, 0.04, (400, 3)))
    stiffness = rng.uniform(1.0, 50.0, 400)
    (w,) = arm_torque_rows_each(particles, chain, [q], friction=0.4)
    (found,) = arm_displacements_each(particles, chain, [q], friction=0.4)
    assert len(found) > 2  # several links hold particles
    expected, data, jacobian = np.zeros((7, 7)), mujoco.MjData(arm.model), np.zeros((3, 7))
    for t in range(7):
        data.qpos[:] = q[t]
        mujoco.mj_forward(arm.model, data)
        for link, moved in found:
            for index, u in zip(*moved.frame(t)):
                mujoco.mj_jac(arm.model, data, jacobian, None, particles[index] + u, arm.body_ids[link])
                expected[t] -= stiffness[index] * u @ jacobian
    assert np.abs((w @ stiffness).reshape(7, 7) - expected).max() < 1e-9 * np.abs(expected).max()
    seen = [set(moved.frame(6)[0]) for _, moved in found]
    assert sum(map(len, seen)) == len(set().union(*seen))  # one holder a particle
    held = np.zeros(400, bool)
    held[list(set().union(*seen))] = True
    assert (reached(particles, chain, np.zeros((0, 4, 4)), q=q) | ~held).all()
    assert np.abs(body_torque(arm, arm.postures(q), np.zeros((7, len(arm.shapes), 3)),
                              moment=np.zeros((7, len(arm.shapes), 3)))).max() == 0.0
