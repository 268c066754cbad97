"""The arm as a MuJoCo model, built from the figures of `gen3`, and the Punyo that it can carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from vsfsim.core.errors import VsfsimError
from vsfsim.robot import gen3

if TYPE_CHECKING:
    import mujoco

Seven = tuple[float, ...]


class ArmError(VsfsimError):
    """A request that the arm cannot fulfil, or a model that is not the arm."""


@dataclass(frozen=True)
class JointParameters:
    """Friction and inertia of the joints.

    The maker publishes none of these values. The defaults are the starting values of a public identification set-up for
    a Gen3 (FIGAROH: friction 3.5 and 1.5 N m, damping 2 N m s/rad, rotors of 0.4e-4 and 0.22e-4 kg m^2 behind a reducer
    of 100:1), for large and small joints. Published identifications differ by a factor of ten, so a study of friction
    should vary them.
    """

    coulomb: Seven = (3.5,) * 4 + (1.5,) * 3
    """Coulomb friction torque (7,) [N m]."""
    viscous: Seven = (2.0,) * 7
    """Viscous damping (7,) [N m s/rad]."""
    armature: Seven = (0.40,) * 4 + (0.22,) * 3
    """Inertia of rotor and reducer, referred to the link (7,) [kg m^2]."""
    sensed_share: float = 0.1
    """Share of the friction that the torque sensor measures, that of the bearings on the link's side of it [-]. An
    assumption: the sensor sits behind the reducer, so it measures little of the friction, but a real Gen3 reads
    different wrenches in the two directions of motion (Kinova-kortex2_Gen3_G3L, issue 145)."""


def arm_model(joints: JointParameters) -> mujoco.MjSpec:
    """The bare arm: bodies, joints, capsules without contact of their own, the site ``flange``, and one motor a joint.

    Args:
        joints: friction and inertia.
    """
    import mujoco

    spec = mujoco.MjSpec()
    spec.modelname = "kinova_gen3"
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    body, number = spec.worldbody, 0
    for link in gen3.LINKS:  # a chain: each body is a child of the one before
        body = body.add_body(name=link.name, pos=link.position, quat=link.quaternion, mass=link.mass, ipos=link.com,
                             iquat=link.inertia_quaternion, inertia=link.inertia, explicitinertial=True)
        if link.joint_range is not None:
            number += 1
            joint = body.add_joint(name=f"joint_{number}", axis=[0.0, 0.0, 1.0])
            if np.isfinite(link.joint_range).all():
                joint.range = link.joint_range
        _add_capsules(body, [c for c in gen3.CAPSULES if c.link == link.name], rgba=[0.75, 0.75, 0.78, 1.0])
    for k in range(gen3.JOINTS):
        joint = spec.joint(f"joint_{k + 1}")
        joint.frictionloss, joint.armature = joints.coulomb[k], joints.armature[k]
        # since MuJoCo 3.3 damping is a polynomial of the rate, with the linear coefficient first; before, a number
        joint.damping = [joints.viscous[k], 0.0, 0.0] if np.ndim(joint.damping) else joints.viscous[k]
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
                                  forcerange=[-gen3.PEAK_TORQUE[k], gen3.PEAK_TORQUE[k]])
        motor.set_to_motor()
    spec.body(gen3.FLANGE_LINK).add_site(name="flange", pos=gen3.FLANGE_POSITION, quat=gen3.FLANGE_QUATERNION)
    spec.option.gravity = [0.0, 0.0, -gen3.GRAVITY]
    spec.option.timestep = 1e-3  # of the dynamic mode [s]: the real arm's low-level loop runs at 1 kHz
    return spec


def add_punyo(spec: mujoco.MjSpec) -> None:
    """Fixes the Punyo to the flange of a Gen3: body ``punyo``, its capsules and mass, and the site ``punyo`` at the
    apex of the dome.

    The site's z is the dome's axis, outwards; its x is along the long axis of the rim.
    """
    flange = _pose(gen3.FLANGE_POSITION, Rotation.from_quat(np.roll(gen3.FLANGE_QUATERNION, -1)).as_matrix())
    pose = flange @ _pose(gen3.PUNYO_POSITION, np.array(gen3.PUNYO_ROTATION))
    body = spec.body(gen3.FLANGE_LINK).add_body(name="punyo", pos=pose[:3, 3], quat=quaternion(pose[:3, :3]),
                                                mass=gen3.PUNYO_MASS, ipos=gen3.PUNYO_COM, inertia=gen3.PUNYO_INERTIA,
                                                explicitinertial=True)
    _add_capsules(body, gen3.PUNYO_CAPSULES, rgba=[0.95, 0.95, 0.9, 1.0])
    z = np.array(gen3.PUNYO_AXIS) / np.linalg.norm(gen3.PUNYO_AXIS)
    x = np.array(gen3.PUNYO_LONG_AXIS) - z * (z @ np.array(gen3.PUNYO_LONG_AXIS))
    x /= np.linalg.norm(x)
    apex = np.array(gen3.PUNYO_RIM_CENTRE) + gen3.PUNYO_HEIGHT * z
    body.add_site(name="punyo", pos=apex, quat=quaternion(np.stack([x, np.cross(z, x), z], axis=1)))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z (4,) of a rotation (3, 3), of the nearest one if it is rounded."""
    import mujoco

    # The published rows are orthogonal to five digits only; scipy takes another rotation than the nearest, 2e-6 away.
    u, _, v = np.linalg.svd(rotation)
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(u @ v).ravel())
    return out


def _add_capsules(body: Any, capsules: list[gen3.LinkCapsule] | tuple[gen3.LinkCapsule, ...], *,
                  rgba: list[float]) -> None:
    """Capsules of a body that are shown but neither collide nor weigh anything."""
    import mujoco

    for k, c in enumerate(capsules):
        body.add_geom(name=f"{body.name}_{k}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*c.start, *c.stop],
                      size=[c.radius, 0.0, 0.0], contype=0, conaffinity=0, mass=0.0, rgba=rgba)


def _pose(position: Any, rotation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, position
    return out
