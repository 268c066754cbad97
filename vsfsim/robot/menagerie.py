"""MuJoCo Menagerie's Gen3, with its meshes, adapted to take the place of our model."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from vsfsim.robot import gen3
from vsfsim.robot.mujoco_model import ArmError, JointParameters, equip

if TYPE_CHECKING:
    import mujoco

MODEL, FILE = "kinova_gen3", "gen3.xml"
FOLDER = "VSFSIM_MENAGERIE"  # environment variable: a copy of Menagerie on this machine
_CLONE = (f"git clone --depth 1 https://github.com/google-deepmind/mujoco_menagerie && export "
          f"{FOLDER}=$PWD/mujoco_menagerie")
_INSTEAD = "or use the arm 'gen3', which has the same frames, masses and capsules and needs no download."


def menagerie_spec(joints: JointParameters | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """The model in the folder ``$VSFSIM_MENAGERIE``, or from the package `mujoco-menagerie`, which downloads it on its
    first use. Bodies, masses and meshes are Menagerie's; the capsules are ours.

    Raises:
        ArmError: there is no model, the package is not installed, the download fails, or the model is not a Gen3.
    """
    folder = os.environ.get(FOLDER, "")
    spec = _from_folder(Path(folder)) if folder else _from_package()
    return adopt(spec, joints, timestep=timestep)


def _from_folder(folder: Path) -> mujoco.MjSpec:
    """The model in a copy of Menagerie, or in its folder kinova_gen3."""
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


def adopt(spec: mujoco.MjSpec, joints: JointParameters | None = None, *, timestep: float = 1e-3) -> mujoco.MjSpec:
    """Equips a Gen3 model like ours (`mujoco_model.equip`), without its servos, its key frames and the contact between
    its meshes.

    Raises:
        ArmError: a body or joint is missing.
    """
    missing = [link.name for link in gen3.LINKS if spec.body(link.name) is None]
    missing += [name for name in (f"joint_{j + 1}" for j in range(gen3.JOINTS)) if spec.joint(name) is None]
    if missing:
        raise ArmError(f"the model is not the Gen3 that we know: it has no {', '.join(missing)}.")
    for old in (*spec.actuators, *spec.keys):
        spec.delete(old)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    equip(spec, joints or JointParameters(), timestep=timestep)
    return spec
