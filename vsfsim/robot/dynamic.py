"""The dynamic arm: MuJoCo simulates it under a joint controller and contact forces, and its torque sensors are read.

    M(q) q'' + c(q, q') + g(q) = motor + friction - armature q'' + J^T f
    motor = stiffness (q_d - q) + damping (q_d' - q') + g + c           the controller compensates g and c

The sensor sits between reducer and link and measures motor - armature q'' + (1 - s) friction, with the sensed share s
of the friction (`JointParameters.sensed_share`). Without the weight, and with the sign of the kinematic arm, the
reading is

    g(q) - sensor = J^T f - M q'' - c + s friction

At rest without friction it is the kinematic arm's J^T f. Inertia, friction and the deflection of the arm (q is not q_d)
change it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, ArmError
from vsfsim.robot.mujoco_model import Seven

if TYPE_CHECKING:
    import mujoco

Contact = Callable[[float, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From the time [s] and the poses of the capsules (K, 4, 4) [m] to the forces on them (K, 3) [N] and the moments about
their origins (K, 3) [N m]."""


@dataclass(frozen=True)
class Drive:
    """The joint controller."""

    stiffness: Seven
    """Proportional gain (7,) [N m/rad]."""
    damping: Seven
    """Derivative gain (7,) [N m s/rad]."""
    settle: float = 0.5
    """Time at the first posture before the readings begin [s]."""


POSITION = Drive((2000.0,) * 4 + (500.0,) * 3, (100.0,) * 4 + (50.0,) * 3)
"""Position control: the gains of MuJoCo Menagerie's `kinova_gen3`; the real ones are not published."""

IMPEDANCE = Drive((200.0,) * 4 + (50.0,) * 3, (30.0,) * 4 + (15.0,) * 3)
"""Joint impedance, ten times softer: an assumption. Friction holds such an arm up to 1 degree away from its desired
angles."""


@dataclass(frozen=True)
class Motion:
    """Motion and readings of the arm at T times."""

    times: np.ndarray
    """Times of the readings (T,) [s]."""
    q: np.ndarray
    """Joint angles (T, 7) [rad]."""
    rate: np.ndarray
    """Joint rates (T, 7) [rad/s]."""
    acceleration: np.ndarray
    """Joint accelerations (T, 7) [rad/s^2]."""
    motor: np.ndarray
    """Torques of the motors (T, 7) [N m]."""
    torque: np.ndarray
    """Readings of the torque sensors without the weight, with the sign of J^T f (T, 7) [N m]."""
    saturated: np.ndarray
    """Whether a motor was at its limit in any step up to the frame (T,) bool."""
    stopped: np.ndarray
    """Whether a joint's stop carried load in any step since the frame before (T,) bool; the sensor of that joint then
    does not read it."""


def simulate(arm: Arm, q: np.ndarray, times: np.ndarray, contact: Contact | None = None, *,
             drive: Drive = POSITION) -> Motion:
    """Moves the arm along ``q`` (T, 7) [rad] at ``times`` (T,) [s], and reads its torques at each of them.

    Between the times the desired angles follow a cubic Hermite curve, at rest at both ends. Before the first time the
    arm settles at the first posture, under the contact of that time.

    Raises:
        ArmError: shapes do not fit, times do not increase, or the state is no longer finite (the gains are too high for
        the time step).
    """
    q, times = arm.check(q), np.asarray(times, float)
    if times.shape != (len(q),) or len(q) < 2 or not (np.diff(times) > 0.0).all():
        raise ArmError(f"times have the shape {times.shape} for {len(q)} postures; give one growing time [s] each, "
                       f"at least two.")
    import mujoco as mj

    model = arm.model
    data = mj.MjData(model)
    data.qpos[:] = q[0]
    step, settle = model.opt.timestep, int(np.ceil(drive.settle / model.opt.timestep))
    # readings are taken at whole steps, at most half a step from the given time
    read_at = settle + np.rint((times - times[0]) / step).astype(int)
    if (np.diff(read_at) < 1).any():
        raise ArmError(f"times are closer than the arm's time step of {step:g} s.")
    wanted = _hermite(times - times[0], q)
    kp, kd = np.array(drive.stiffness), np.array(drive.damping)
    peak = np.array(gen3.PEAK_TORQUE)
    capsules = _Capsules(arm)
    rows: list[tuple[np.ndarray, ...]] = []
    saturated = stopped = False
    for n in range(read_at[-1] + 1):
        time = max(0.0, (n - settle) * step)
        mj.mj_step1(model, data)
        angle, rate = wanted(time)
        data.ctrl[:] = np.clip(kp * (angle - data.qpos) + kd * (rate - data.qvel) + data.qfrc_bias, -peak, peak)
        saturated |= bool((np.abs(data.ctrl) >= peak).any())
        if contact is not None:
            poses = capsules.poses(data)
            capsules.apply(data, poses, *contact(times[0] + time, poses))
        before = data.qpos.copy(), data.qvel.copy()
        mj.mj_step2(model, data)
        stopped |= bool((data.efc_force[data.efc_type == mj.mjtConstraint.mjCNSTR_LIMIT_JOINT] != 0.0).any())
        if n == read_at[len(rows)]:
            friction = data.qfrc_damper + _coulomb(data)
            sensor = data.qfrc_actuator - model.dof_armature * data.qacc + (1.0 - arm.joints.sensed_share) * friction
            rows.append((*before, data.qacc.copy(), data.qfrc_actuator.copy(), sensor, np.array(saturated),
                         np.array(stopped)))
            stopped = False
    angles, rates, accelerations, motor, sensor, full, stop = (np.array(column) for column in zip(*rows, strict=True))
    if not all(np.isfinite(a).all() for a in (angles, rates, sensor)):
        raise ArmError("the simulated arm did not stay finite; its gains are too high for its time step, or the "
                       "contact forces are.")
    return Motion(times.copy(), angles, rates, accelerations, motor, arm.gravity_torque(angles) - sensor, full, stop)


def series(times: np.ndarray, force: np.ndarray, moment: np.ndarray) -> Contact:
    """A contact with given forces and moments on the capsules (T, K, 3) [N, N m] at ``times`` (T,) [s], interpolated
    linearly.

    So the frames of the quasi-static solver act on the dynamic arm; the arm's deflection does not act back on the
    object.
    """
    times, both = np.asarray(times, float), np.stack([force, moment]).astype(float)

    def contact(time: float, _: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        share = np.clip((time - times[k]) / (times[k + 1] - times[k]), 0.0, 1.0)
        now = (1.0 - share) * both[:, k] + share * both[:, k + 1]
        return now[0], now[1]

    return contact


class _Capsules:
    """The capsules during a simulation: their poses, and their forces on MuJoCo's bodies."""

    def __init__(self, arm: Arm):
        self.bodies = arm.body_ids[arm.capsule_links]
        self.local = arm.capsule_offsets
        self.frames = np.tile(np.eye(4), (len(self.bodies), 1, 1))

    def poses(self, data: mujoco.MjData) -> np.ndarray:
        out = self.frames
        out[:, :3, :3], out[:, :3, 3] = data.xmat[self.bodies].reshape(-1, 3, 3), data.xpos[self.bodies]
        return out @ self.local

    def apply(self, data: mujoco.MjData, poses: np.ndarray, force: np.ndarray, moment: np.ndarray) -> None:
        # xfrc_applied is a force at the body's centre of mass and a torque about it
        lever = poses[:, :3, 3] - data.xipos[self.bodies]
        data.xfrc_applied[:] = 0.0
        np.add.at(data.xfrc_applied, self.bodies, np.concatenate([force, moment + np.cross(lever, force)], axis=1))


def _coulomb(data: mujoco.MjData) -> np.ndarray:
    """Coulomb friction torques (7,) [N m], which MuJoCo stores among its constraints."""
    import mujoco as mj

    out = np.zeros(gen3.JOINTS)
    rows = data.efc_type == mj.mjtConstraint.mjCNSTR_FRICTION_DOF
    out[data.efc_id[rows]] = data.efc_force[rows]
    return out


def _hermite(times: np.ndarray, q: np.ndarray) -> Callable[[float], tuple[np.ndarray, np.ndarray]]:
    """Angle and rate at a time, on a cubic through ``q`` with the slopes of central differences, 0 at both ends."""
    slope = np.gradient(q, times, axis=0) if len(q) > 2 else np.zeros_like(q)
    slope[[0, -1]] = 0.0
    # no slope, and so no overshoot, where the desired angles stand still
    still = (np.diff(q, axis=0) == 0.0).all(axis=1)
    slope[:-1][still] = slope[1:][still] = 0.0

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        h = times[k + 1] - times[k]
        s = min(1.0, (time - times[k]) / h)
        a, b, u, v = q[k], q[k + 1], h * slope[k], h * slope[k + 1]
        angle = (1 + 2 * s) * (1 - s) ** 2 * a + s * (1 - s) ** 2 * u + s * s * (3 - 2 * s) * b + s * s * (s - 1) * v
        rate = 6 * s * (s - 1) * (a - b) + (1 - s) * (1 - 3 * s) * u + s * (3 * s - 2) * v
        return angle, rate / h

    return at
