"""The difference between the readings of the kinematic and the dynamic arm, and its causes."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from vsfsim.robot.arm import Arm
from vsfsim.robot.dynamic import POSITION, Drive, Motion, series, simulate
from vsfsim.robot.joint_torque import body_torque


@dataclass(frozen=True)
class Difference:
    """The dynamic arm's readings less the kinematic arm's torques, under the same forces on the same path."""

    kinematic: np.ndarray
    """J^T f at the desired angles (T, 7) [N m]."""
    dynamic: np.ndarray
    """Readings of the dynamic arm without its weight (T, 7) [N m]."""
    rms: np.ndarray
    """Root mean square of the difference, each joint (7,) [N m]."""
    largest: np.ndarray
    """Largest difference, each joint (7,) [N m]."""
    scale: float
    """Largest kinematic torque of any joint [N m]."""
    inertia: np.ndarray
    """Rms of the part by inertia and Coriolis torques (7,) [N m]."""
    friction: np.ndarray
    """Rms of the part by friction that the sensor measures (7,) [N m]."""
    lag: np.ndarray
    """Rms of the part by the actual instead of the desired angles in J^T f (7,) [N m]."""
    tool: float
    """Largest distance of the tool from its path [m]."""
    motion: Motion
    """What the dynamic arm did."""
    seconds: tuple[float, float]
    """Computing time of the kinematic and of the dynamic arm [s]."""


def difference(arm: Arm, q: np.ndarray, times: np.ndarray, force: np.ndarray, moment: np.ndarray, *,
               drive: Drive = POSITION) -> Difference:
    """Runs both arms along ``q`` (T, 7) [rad] at ``times`` (T,) [s].

    Args:
        force, moment: on the capsules, moments about their origins (T, K, 3) [N, N m]. In the dynamic arm they move
        along with the capsules.
        drive: controller of the dynamic arm.
    """
    begin = time.perf_counter()
    kinematic = body_torque(arm, q, force, moment=moment)
    middle = time.perf_counter()
    motion = simulate(arm, q, times, series(times, force, moment), drive=drive)
    end = time.perf_counter()
    there = body_torque(arm, motion.q, force, moment=moment)
    # Friction is what remains after J^T f and inertia. Computed from the rates it would be wrong at rest, where their
    # signs are rounding errors.
    inertial = inertial_torque(arm, motion)
    gap = motion.torque - kinematic
    away = arm.postures(motion.q).tool[:, :3, 3] - arm.postures(q).tool[:, :3, 3]
    return Difference(kinematic, motion.torque, _rms(gap), np.abs(gap).max(axis=0), float(np.abs(kinematic).max()),
                      _rms(inertial), _rms(motion.torque - there - inertial), _rms(there - kinematic),
                      float(np.linalg.norm(away, axis=1).max()), motion, (middle - begin, end - middle))


def inertial_torque(arm: Arm, motion: Motion) -> np.ndarray:
    """-M q'' - c (T, 7) [N m] without the armatures, which are on the motor's side of the sensors."""
    import mujoco as mj

    data = mj.MjData(arm.model)
    out = np.empty_like(motion.q)
    for t in range(len(out)):
        data.qpos[:], data.qvel[:], data.qacc[:] = motion.q[t], motion.rate[t], motion.acceleration[t]
        mj.mj_kinematics(arm.model, data)
        mj.mj_comPos(arm.model, data)
        mj.mj_comVel(arm.model, data)
        mj.mj_rne(arm.model, data, 1, out[t])  # without the armatures, which MuJoCo adds elsewhere
    return arm.gravity_torque(motion.q) - out


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))
