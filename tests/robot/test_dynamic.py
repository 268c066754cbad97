"""The dynamic arm: its balance of torques, its slow limit, and the effects of speed and friction."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from vsfsim.core.rotation import rotation_matrix
from vsfsim.robot.arm import Arm, ArmError
from vsfsim.robot.dynamic import IMPEDANCE, POSITION, Drive, series, simulate
from vsfsim.robot.joint_torque import body_torque
from vsfsim.robot.mujoco_model import JointParameters
from vsfsim.robot.reach import straight_touch

FRAMES = 21


def rms(values):
    return np.sqrt((values**2).mean(axis=0))


def inertial_torque(arm, motion):
    """-M q'' - c (T, 7) [N m], without the armatures, which are on the motor's side of the sensors."""
    data, out = mujoco.MjData(arm.model), np.empty_like(motion.q)
    for t in range(len(out)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[t], motion.rate[t], motion.acceleration[t]
        mujoco.mj_fwdPosition(arm.model, data)
        mujoco.mj_fwdVelocity(arm.model, data)
        mujoco.mj_rne(arm.model, data, 1, out[t])
    return arm.gravity_torque(motion.q) - out


def difference(arm, q, times, force, moment):
    """The dynamic arm's readings less the kinematic arm's torques along ``q``: whole and by part, rms of a joint."""
    kinematic, motion = body_torque(arm, q, force, moment=moment), simulate(arm, q, times, series(times, force, moment))
    there, inertial = body_torque(arm, motion.q, force, moment=moment), inertial_torque(arm, motion)
    gap = motion.torque - kinematic
    away = arm.postures(motion.q).tool[:, :3, 3] - arm.postures(q).tool[:, :3, 3]
    # friction is what remains: computed from the rates it would be wrong at rest, where their signs are rounding errors
    return SimpleNamespace(dynamic=motion.torque, motion=motion, rms=rms(gap), largest=np.abs(gap).max(axis=0),
                           scale=np.abs(kinematic).max(), inertia=rms(inertial), lag=rms(there - kinematic),
                           friction=rms(motion.torque - there - inertial), tool=np.linalg.norm(away, axis=1).max())


def smooth(n):
    """0 to 1 with no jump of speed (n, 1)."""
    t = np.linspace(0.0, 1.0, n)[:, None]
    return t**3 * (10 - 15 * t + 6 * t * t)


@pytest.fixture(scope="module")
def blind():
    """An arm whose sensors see no friction."""
    return Arm(joints=JointParameters(sensed_share=0.0))


@pytest.fixture(scope="module")
def touch(blind):
    """6 cm with growing forces on forearm and wrist, slow at both ends: angles, forces, moments."""
    fine = straight_touch(blind, [0.45, 0.05, 0.35], [0.51, 0.05, 0.35], rotation_matrix((0.0, np.pi / 2, 0.0)),
                          frames=201)
    q = fine[np.rint(200 * smooth(FRAMES)[:, 0]).astype(int)]
    force, moment = np.zeros((2, FRAMES, len(blind.shapes), 3))
    force[:, 9], force[:, 14] = smooth(FRAMES) * [-3, 1, 0], smooth(FRAMES) * [-8, 0, 2]
    moment[:, 14] = smooth(FRAMES) * [0, 0.2, 0.1]
    return q, force, moment


@pytest.fixture(scope="module")
def slow(blind, touch):
    q, force, moment = touch
    return difference(blind, q, np.linspace(0.0, 6.0, FRAMES), force, moment)


def test_in_the_slow_limit_both_arms_read_the_same(slow):
    """6 cm in 6 s: what is left is inertia and that the arm gives way by friction over stiffness. 2 % of the largest
    torque holds both."""
    assert slow.scale > 1.5
    assert slow.largest.max() < 0.02 * slow.scale
    assert slow.tool < 2.5e-3, ("3.5 N m of friction over 2000 N m/rad is 1.75 mrad, in two or three joints of an arm "
                                "half a metre long")
    assert not slow.motion.saturated.any()


def test_the_balance_of_torques_closes(blind, touch):
    """Reading = J^T f - M q'' - c: with times on whole steps nothing is left over but rounding."""
    q, force, moment = touch
    d = difference(blind, q, np.arange(FRAMES) * 0.1, force, moment)
    assert d.friction.max() < 1e-7
    assert d.inertia.max() > 1e-3 and d.lag.max() > 1e-5, "there is something to close"


def test_a_soft_arm_gives_way_by_torque_over_stiffness():
    """Held without friction against a force, every joint turns by J^T f over its stiffness."""
    arm = Arm(joints=JointParameters(coulomb=(0.0,) * 7))
    q = np.tile(np.array([0.0, 0.26, 3.14, -2.27, 0.0, 0.96, 1.57]), (3, 1))
    force, moment = np.zeros((2, 3, len(arm.shapes), 3))
    force[:, 15] = [5.0, -3.0, 2.0]
    soft = Drive(IMPEDANCE.stiffness, IMPEDANCE.damping, settle=3.0)
    motion = simulate(arm, q, np.array([0.0, 0.1, 0.2]), series(np.array([0.0, 0.1, 0.2]), force, moment), drive=soft)
    torque = body_torque(arm, motion.q, force, moment=moment)
    assert (motion.q - q)[-1] * soft.stiffness == pytest.approx(torque[-1], abs=1e-3)
    assert motion.torque[-1] == pytest.approx(torque[-1], abs=1e-3) and np.abs(torque).max() > 1.0
    stiff = simulate(arm, q, np.array([0.0, 0.1, 0.2]), series(np.array([0.0, 0.1, 0.2]), force, moment),
                     drive=POSITION)
    assert np.abs(stiff.q - q).max() < 0.2 * np.abs(motion.q - q).max()


def test_a_wall_that_feels_the_arm(blind, touch):
    """Two-way contact: a spring between wall and wrist; force and reading belong to where the arm is, not to where it
    was sent."""
    q, _, _ = touch
    wall, stiffness, k = blind.body_poses(q)[-1, 14, 0, 3] - 0.01, 2000.0, 14

    def contact(_, poses):
        force, moment = np.zeros((2, len(poses), 3))
        force[k, 0] = -stiffness * max(0.0, poses[k, 0, 3] - wall)
        return force, moment

    motion = simulate(blind, q, np.arange(FRAMES) * 0.2, contact, drive=IMPEDANCE)
    force = np.zeros((FRAMES, len(blind.shapes), 3))
    force[:, k, 0] = -stiffness * np.maximum(0.0, blind.body_poses(motion.q)[:, k, 0, 3] - wall)
    at_rest = motion.torque - inertial_torque(blind, motion)
    assert at_rest == pytest.approx(body_torque(blind, motion.q, force, moment=np.zeros_like(force)), abs=1e-6)
    assert force.min() < -2.0 and np.abs(motion.q - q)[-1].max() > 1e-3


def at_stop(arm, joint, away):
    """Held ``away`` [rad] from the upper stop of a joint, without friction, by a force that turns the joint towards it:
    the motion, and J^T f."""
    q = np.array([0.0, 0.26, 3.14, -2.0, 0.0, 0.96, 1.57])
    q[joint] = arm.upper[joint] - away
    q, times = np.tile(q, (3, 1)), np.array([0.0, 0.1, 0.2])
    force, moment = np.zeros((2, 3, len(arm.shapes), 3))
    push = 5.0 * np.eye(3)[:, None] * (np.arange(len(arm.shapes)) == len(arm.shapes) - 1)[None, :, None]
    turns = [body_torque(arm, q[:1], p[None], moment=0.0 * p[None])[0, joint] for p in push]
    force[:, -1] = 5.0 * np.array(turns) / np.linalg.norm(turns)
    motion = simulate(arm, q, times, series(times, force, moment), drive=IMPEDANCE)
    return motion, body_torque(arm, motion.q, force, moment=moment)


@pytest.mark.parametrize("joint", [1, 3, 5])
def test_a_joint_at_its_stop_is_marked_and_one_at_the_margin_reads_the_contact(joint):
    """At a stop MuJoCo's constraint carries the load, and the sensor reads a part of J^T f, 0.054 of 0.502 N m once."""
    arm = Arm(joints=JointParameters(coulomb=(0.0,) * 7))
    motion, torque = at_stop(arm, joint, 1e-3)
    assert motion.stopped.all() and torque[-1, joint] > 0.3
    assert motion.torque[-1, joint] < 0.5 * torque[-1, joint], "or there is nothing to mark"
    motion, torque = at_stop(arm, joint, np.radians(3.0))
    assert not motion.stopped.any() and not motion.saturated.any()
    assert motion.torque[-1] == pytest.approx(torque[-1], abs=0.02)


def test_what_cannot_be_run_is_refused(blind, touch):
    q, _, _ = touch
    with pytest.raises(ArmError, match="growing time"):
        simulate(blind, q, np.zeros(FRAMES))
    with pytest.raises(ArmError, match="closer than"):
        simulate(blind, q, np.linspace(0.0, 1e-3, FRAMES))
