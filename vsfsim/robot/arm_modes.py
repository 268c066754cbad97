"""How far the two arms are apart: one rung of the trade of accuracy against time."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from vsfsim.robot.arm import Arm
from vsfsim.robot.dynamic import POSITION, Drive, Motion, series, simulate
from vsfsim.robot.joint_torque import body_torque

MODES = ("kinematic", "dynamic")


@dataclass(frozen=True)
class Difference:
    """The dynamic arm's readings less the kinematic arm's torques, under the same forces on the same path.

    kinematic: J^T f at the wanted angles (T, 7) [N m]. dynamic: readings, weight taken off (T, 7) [N m].
    rms, largest: of the difference, each joint (7,) [N m]. scale: largest kinematic torque of any joint [N m].
    inertia, friction, lag: rms of its parts (7,) [N m]: M q'' and Coriolis; friction that the sensor sees; J^T f at the
    angles that the arm has instead of the wanted ones. tool: largest distance of the tool from its path [m].
    motion: what the dynamic arm did. seconds: time that each took, kinematic and dynamic (2,) [s].
    """

    kinematic: np.ndarray
    dynamic: np.ndarray
    rms: np.ndarray
    largest: np.ndarray
    scale: float
    inertia: np.ndarray
    friction: np.ndarray
    lag: np.ndarray
    tool: float
    motion: Motion
    seconds: tuple[float, float]


def difference(arm: Arm, q: np.ndarray, times: np.ndarray, force: np.ndarray, moment: np.ndarray, *,
               drive: Drive = POSITION) -> Difference:
    """Runs both arms along ``q`` (T, 7) [rad] at ``times`` (T,) [s].

    Args:
        force, moment: on the capsules, moments about their origins (T, K, 3) [N, N m]; at each frame's place in the
        kinematic arm, while the
            dynamic one carries them along.
    """
    begin = time.perf_counter()
    kinematic = body_torque(arm, q, force, moment=moment)
    middle = time.perf_counter()
    motion = simulate(arm, q, times, series(times, force, moment), drive=drive)
    end = time.perf_counter()
    there = body_torque(arm, motion.q, force, moment=moment)
    # the sign of a rate that is rounding says nothing: what is left over after J^T f and inertia is the friction,
    # whatever it is at rest
    inertial = inertial_torque(arm, motion)
    gap = motion.torque - kinematic
    away = arm.postures(motion.q).tool[:, :3, 3] - arm.postures(q).tool[:, :3, 3]
    return Difference(kinematic, motion.torque, _rms(gap), np.abs(gap).max(axis=0), float(np.abs(kinematic).max()),
                      _rms(inertial),
                      _rms(motion.torque - there - inertial), _rms(there - kinematic),
                      float(np.linalg.norm(away, axis=1).max()), motion,
                      (middle - begin, end - middle))


def inertial_torque(arm: Arm, motion: Motion) -> np.ndarray:
    """-M q'' - c (T, 7) [N m], without the armatures, which are on the motor's side of the sensors."""
    import mujoco as mj

    data = mj.MjData(arm.model)
    out = np.empty_like(motion.q)
    for t in range(len(out)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[t], motion.rate[t], motion.acceleration[t]
        mj.mj_kinematics(arm.model, data)
        mj.mj_comPos(arm.model, data)
        mj.mj_comVel(arm.model, data)
        mj.mj_rne(arm.model, data, 1, out[t])  # its inertias are those of the links; MuJoCo adds armature elsewhere
    return arm.gravity_torque(motion.q) - out


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))
