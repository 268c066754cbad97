"""MuJoCo Menagerie's Gen3, with its meshes, made ready to take the place of ours: same names, motors for its position servos."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vsfsim.robot import gen3, mjcf
from vsfsim.robot.arm import ArmError

if TYPE_CHECKING:
    import mujoco

MODEL = "kinova_gen3"


def menagerie_spec(joints: mjcf.JointFigures | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """The model, downloaded by the package `mujoco-menagerie` on its first use. Bodies, masses and meshes are Menagerie's, capsules ours.

    Raises:
        ArmError: the package is not installed, the model cannot be downloaded, or it is not the arm that we know.
    """
    instead = "or use the arm 'gen3', which has the same frames, masses and capsules and needs no download."
    try:
        import mujoco_menagerie
    except ImportError:
        raise ArmError(f"the arm 'menagerie' needs the package mujoco-menagerie: `pip install mujoco-menagerie`, {instead}") from None
    try:
        robot = mujoco_menagerie.get(MODEL)
        spec = robot.spec(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise ArmError(f"the model {MODEL} of MuJoCo Menagerie cannot be had: {error}. "
                       f"It is downloaded on its first use, so this needs a way to github.com once; {instead}") from error
    return adopt(spec, joints, timestep=timestep)


def adopt(spec: mujoco.MjSpec, joints: mjcf.JointFigures | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """Gives a Gen3 model what ours has: site, motors and friction; takes away servos, key frames and contact between its own meshes.

    Raises:
        ArmError: a body or joint is missing.
    """
    joints = joints or mjcf.JointFigures()
    names = {body.name for body in spec.bodies}
    missing = [link.name for link in gen3.LINKS if link.name not in names]
    found = {joint.name: joint for joint in spec.joints}
    missing += [f"joint_{j + 1}" for j in range(gen3.JOINTS) if f"joint_{j + 1}" not in found]
    if missing:
        raise ArmError(f"the model is not the Gen3 that we know: it has no {', '.join(missing)}.")
    for old in (*spec.actuators, *spec.keys):
        spec.delete(old)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for j in range(gen3.JOINTS):
        joint = found[f"joint_{j + 1}"]
        joint.frictionloss, joint.armature = joints.coulomb[j], joints.armature[j]
        _set_damping(joint, joints.viscous[j])
        peak = gen3.PEAK_TORQUE[j]
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=_joint_transmission(), forcelimited=True, forcerange=[-peak, peak])
        motor.set_to_motor()
    spec.body(gen3.FLANGE_LINK).add_site(name="flange", pos=gen3.FLANGE_POSITION, quat=gen3.FLANGE_QUATERNION)
    spec.option.gravity = [0.0, 0.0, -gen3.GRAVITY]
    spec.option.timestep = timestep
    return spec


def _joint_transmission() -> int:
    import mujoco

    return mujoco.mjtTrn.mjTRN_JOINT


def _set_damping(joint: object, value: float) -> None:
    # newer MuJoCo: a polynomial of the rate, the linear coefficient first; older: a number
    joint.damping = [value, 0.0, 0.0] if np.ndim(joint.damping) else value  # type: ignore[attr-defined]
