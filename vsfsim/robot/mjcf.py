"""The arm as MJCF of our own, written from the figures of `gen3`; the Punyo is a part that any Gen3 model can carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vsfsim.robot import gen3

if TYPE_CHECKING:
    import mujoco

Seven = tuple[float, ...]


@dataclass(frozen=True)
class JointFigures:
    """What the joints resist a motion with; one value a joint (7,).

    coulomb: friction torque (7,) [N m]. viscous: damping (7,) [N m s/rad]. armature: inertia of rotor and reducer, seen
    from the link (7,) [kg m^2].
    seen: share of the friction that the torque sensor sees, as a fraction: that of the bearings on the link's side of
    it [-].

    The maker publishes none of them. The defaults are the starting values of a public identification set-up for a Gen3
    (FIGAROH:
    friction 3.5 and 1.5 N m, damping 2 N m s/rad, rotors of 0.4e-4 and 0.22e-4 kg m^2 behind a reducer of 100:1), large
    joints and small.
    Published identifications spread over a factor of ten, so a study of friction should vary them. ``seen`` is an
    assumption: the sensor sits behind the reducer, so it sees little of the friction, but a real Gen3 reads another
    wrench going forth than going back (Kinova-kortex2_Gen3_G3L, issue 145).
    """

    coulomb: Seven = (3.5,) * 4 + (1.5,) * 3
    viscous: Seven = (2.0,) * 7
    armature: Seven = (0.40,) * 4 + (0.22,) * 3
    seen: float = 0.1

    def seen_friction(self, rate: np.ndarray) -> np.ndarray:
        """Friction torque (T, 7) [N m] that the sensors see at joint rates (T, 7) [rad/s]; 0 at rest, where it may be
        anything up to Coulomb's."""
        return -self.seen * (np.array(self.coulomb) * np.sign(rate) + np.array(self.viscous) * rate)


def arm_xml(joints: JointFigures | None = None, *, timestep: float = 1e-3) -> str:
    """MJCF text of the bare arm: bodies, joints, capsules that touch nothing by themselves, the site ``flange``, one
    motor a joint.

    Args:
        joints: friction, damping and armature; `JointFigures()` by default.
        timestep: of the dynamic mode [s]; 1 kHz is the rate of the real arm's low-level loop.
    """
    joints = joints or JointFigures()
    out = ['<mujoco model="kinova_gen3">',
           '  <compiler angle="radian" autolimits="true"/>',
           f'  <option timestep={_q(timestep)} gravity={_q((0.0, 0.0, -gen3.GRAVITY))} integrator="implicitfast"/>',
           '  <default><geom contype="0" conaffinity="0" mass="0" rgba="0.75 0.75 0.78 1"/></default>',
           "  <worldbody>"]
    number = 0
    for depth, link in enumerate(gen3.LINKS):  # a chain: each hangs on the one before
        pad = "  " * (depth + 2)
        out.append(f'{pad}<body name="{link.name}" pos={_q(link.position)} quat={_q(link.quaternion)}>')
        out.append(f'{pad}  <inertial pos={_q(link.com)} quat={_q(link.inertia_quaternion)} mass={_q(link.mass)} '
                   f'diaginertia={_q(link.inertia)}/>')
        if link.joint_range is not None:
            limits = f" range={_q(link.joint_range)}" if np.isfinite(link.joint_range).all() else ""
            out.append(f'{pad}  <joint name="joint_{number + 1}" axis="0 0 1"{limits} '
                       f'frictionloss={_q(joints.coulomb[number])} '
                       f'damping={_q(joints.viscous[number])} armature={_q(joints.armature[number])}/>')
            number += 1
        for i, capsule in enumerate(c for c in gen3.CAPSULES if c.link == link.name):
            out.append(f'{pad}  <geom name="{link.name}_{i}" type="capsule" fromto={_q(capsule.start + capsule.stop)} '
                       f'size={_q(capsule.radius)}/>')
        if link.name == gen3.FLANGE_LINK:
            out.append(f'{pad}  <site name="flange" pos={_q(gen3.FLANGE_POSITION)} quat={_q(gen3.FLANGE_QUATERNION)}/>')
    out += ["  " * (depth + 2) + "</body>" for depth in reversed(range(len(gen3.LINKS)))]
    out += ["  </worldbody>", "  <actuator>"]
    out += [f'    <motor name="joint_{j + 1}" joint="joint_{j + 1}" forcerange={_q((-peak, peak))}/>' for j,
            peak in enumerate(gen3.PEAK_TORQUE)]
    return "\n".join([*out, "  </actuator>", "</mujoco>", ""])


def add_punyo(spec: mujoco.MjSpec) -> None:
    """Fixes the Punyo to the flange of a Gen3 model: body ``punyo``, its capsules, mass, and the site ``punyo`` at the
    apex of the dome.

    The site's z is the dome's axis, outwards; its x runs along the rim's long axis.
    """
    import mujoco

    flange = _pose(gen3.FLANGE_POSITION, _rotation(gen3.FLANGE_QUATERNION))
    pose = flange @ _pose(gen3.PUNYO_POSITION, np.array(gen3.PUNYO_ROTATION))
    body = spec.body(gen3.FLANGE_LINK).add_body(name="punyo", pos=pose[:3, 3], quat=quaternion(pose[:3, :3]),
                                                mass=gen3.PUNYO_MASS,
                                                ipos=gen3.PUNYO_COM, inertia=gen3.PUNYO_INERTIA, explicitinertial=True)
    for i, c in enumerate(gen3.PUNYO_CAPSULES):
        body.add_geom(name=f"punyo_{i}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*c.start, *c.stop],
                      size=[c.radius, 0.0, 0.0],
                      contype=0, conaffinity=0, mass=0.0, rgba=[0.95, 0.95, 0.9, 1.0])
    z = np.array(gen3.PUNYO_AXIS) / np.linalg.norm(gen3.PUNYO_AXIS)
    x = np.array(gen3.PUNYO_LONG_AXIS) - z * (z @ np.array(gen3.PUNYO_LONG_AXIS))
    x /= np.linalg.norm(x)
    apex = np.array(gen3.PUNYO_RIM_CENTRE) + 0.0305 * z
    body.add_site(name="punyo", pos=apex, quat=quaternion(np.stack([x, np.cross(z, x), z], axis=1)))


def _q(value: Any) -> str:
    # repr keeps every digit: the model is exactly the table
    return f'"{" ".join(repr(float(v)) for v in np.atleast_1d(value))}"'


def _pose(position: Any, rotation: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, position
    return out


def _rotation(quaternion: gen3.Quaternion) -> np.ndarray:
    import mujoco

    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.array(quaternion, float) / np.linalg.norm(quaternion))
    return out.reshape(3, 3)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z (4,) of a rotation (3, 3), of the nearest one if it is rounded."""
    import mujoco

    # the published rows are orthogonal to five digits only
    u, _, v = np.linalg.svd(rotation)
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, np.ascontiguousarray(u @ v).ravel())
    return out
