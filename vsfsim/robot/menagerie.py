"""MuJoCo Menagerie's Gen3, with its meshes, made ready to take the place of ours: same names, motors for its position
servos."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.robot import gen3, mjcf
from vsfsim.robot.arm import ArmError

if TYPE_CHECKING:
    import mujoco

MODEL, FILE = "kinova_gen3", "gen3.xml"
FOLDER = "VSFSIM_MENAGERIE"  # environment variable: a copy of Menagerie on this machine
_CLONE = (f"git clone --depth 1 https://github.com/google-deepmind/mujoco_menagerie && export "
          f"{FOLDER}=$PWD/mujoco_menagerie")
_INSTEAD = "or use the arm 'gen3', which has the same frames, masses and capsules and needs no download."


def menagerie_spec(joints: mjcf.JointFigures | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """The model from the folder that ``$VSFSIM_MENAGERIE`` names, or downloaded by the package `mujoco-menagerie` on
    its first use. Bodies, masses and meshes are Menagerie's, capsules ours.

    Raises:
        ArmError: no model there, the package is not installed, the model cannot be downloaded, or it is not the arm
        that we know.
    """
    folder = os.environ.get(FOLDER, "")
    spec = _from_folder(Path(folder)) if folder else _from_package()
    return adopt(spec, joints, timestep=timestep)


def _from_folder(folder: Path) -> mujoco.MjSpec:
    """The model of a copy of Menagerie, or of its folder kinova_gen3."""
    import mujoco

    for file in (folder / MODEL / FILE, folder / FILE):
        if file.is_file():
            try:
                return mujoco.MjSpec.from_file(str(file))
            except ValueError as error:
                raise ArmError(f"{FOLDER}: MuJoCo cannot read '{file}': {error}") from error
    raise ArmError(f"{FOLDER} is '{folder}', but neither {MODEL}/{FILE} nor {FILE} is there. Get it with "
                   f"`{_CLONE}`, {_INSTEAD}")


def _from_package() -> mujoco.MjSpec:
    try:
        import mujoco_menagerie
    except ImportError:
        raise ArmError(f"the arm 'menagerie' needs the package mujoco-menagerie: `pip install mujoco-menagerie`; or "
                       f"get the models with `{_CLONE}`, {_INSTEAD}") from None
    try:
        robot = mujoco_menagerie.get(MODEL)
        return robot.spec(robot.default_model)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        raise ArmError(f"the model {MODEL} of MuJoCo Menagerie cannot be had: {error}. "
                       f"It is downloaded on its first use, so this needs a way to github.com once; or get it "
                       f"elsewhere with `{_CLONE}`, {_INSTEAD}") from error


def adopt(spec: mujoco.MjSpec, joints: mjcf.JointFigures | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """Gives a Gen3 model what ours has: site, motors and friction; takes away servos, key frames and contact between
    its own meshes.

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
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=_joint_transmission(), forcelimited=True,
                                  forcerange=[-peak, peak])
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
