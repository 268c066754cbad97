"""All numbers of the Kinova Gen3 (7 joints) and of the Punyo on its flange, with their sources.

[table]: frames, masses, inertias, joint ranges, flange and torque limits are from the maker's public description of the
arm (ros_kortex, GEN3_URDF_V12) in the form of MuJoCo Menagerie's `kinova_gen3`. `tests/robot/kinova_gen3.md` is that
table, and a test compares it with this file.

[mesh]: girths are coordinates read off the maker's public surface meshes in the link frames (the copies in robosuite's
`kinova3` and in Menagerie's `kinova_gen3_7dof`) for shoulder, half arm 1, forearm, spherical wrist 1 and bracelet in
part. Half arm 2 and spherical wrist 2 are assumed to be like their neighbours, and the depth of the small housings is
an estimate. The capsules are our fit, see `CAPSULES`.

[openvsf]: mount and frame of the Punyo are those of openvsf.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

CONTINUOUS = (-math.inf, math.inf)
GRAVITY = 9.81  # m/s^2, along -z of the base
JOINTS = 7


@dataclass(frozen=True)
class Link:
    """A body of the arm. Its joint rotates about its own +z."""

    name: str
    """Name of the body."""
    position: Vector
    """Origin of its frame in that of the link before (3,) [m]."""
    quaternion: Quaternion
    """Rotation of its frame in that of the link before, w x y z (4,), not normalised."""
    joint_range: tuple[float, float] | None
    """Least and largest angle [rad], infinite for a continuous joint; None for no joint."""
    mass: float
    """Mass [kg]."""
    com: Vector
    """Centre of mass (3,) [m]."""
    inertia_quaternion: Quaternion
    """Rotation of the principal axes, w x y z (4,)."""
    inertia: Vector
    """Principal moments of inertia about the centre of mass (3,) [kg m^2]."""


LINKS = (  # [table]
    Link("base_link", (0, 0, 0), (1, 0, 0, 0), None, 1.697,
         (-0.000648, -0.000166, 0.084487), (0.999294, 0.00139618, -0.0118387, 0.035636),
         (0.00462407, 0.00449437, 0.00207755)),
    Link("shoulder_link", (0, 0, 0.15643), (0, 1, 0, 0), CONTINUOUS, 1.3773,
         (-2.3e-05, -0.010364, -0.07336), (0.707051, 0.0451246, -0.0453544, 0.704263),
         (0.00488868, 0.00457, 0.00135132)),
    Link("half_arm_1_link", (0, 0.005375, -0.12838), (1, 1, 0, 0), (-2.24, 2.24), 1.1636,
         (-4.4e-05, -0.09958, -0.013278), (0.482348, 0.516286, -0.516862, 0.483366), (0.0113017, 0.011088, 0.00102532)),
    Link("half_arm_2_link", (0, -0.21038, -0.006375), (1, -1, 0, 0), CONTINUOUS, 1.1636,
         (-4.4e-05, -0.006641, -0.117892), (0.706144, 0.0213722, -0.0209128, 0.707437),
         (0.0111633, 0.010932, 0.00100671)),
    Link("forearm_link", (0, 0.006375, -0.21038), (1, 1, 0, 0), (-2.57, 2.57), 0.9302,
         (-1.8e-05, -0.075478, -0.015006), (0.483678, 0.515961, -0.515859, 0.483455),
         (0.00834839, 0.008147, 0.000598606)),
    Link("spherical_wrist_1_link", (0, -0.20843, -0.006375), (1, -1, 0, 0), CONTINUOUS, 0.6781,
         (1e-06, -0.009432, -0.063883), (0.703558, 0.0707492, -0.0707492, 0.703558),
         (0.00165901, 0.001596, 0.000346988)),
    Link("spherical_wrist_2_link", (0, 0.00017505, -0.10593), (1, 1, 0, 0), (-2.09, 2.09),
         0.6781,
         (1e-06, -0.045483, -0.00965), (0.44426, 0.550121, -0.550121, 0.44426), (0.00170087, 0.001641, 0.00035013)),
    Link("bracelet_link", (0, -0.10593, -0.00017505), (1, -1, 0, 0), CONTINUOUS, 0.5,
         (0.000281, 0.011402, -0.029798), (0.394358, 0.596779, -0.577293, 0.393789),
         (0.000657336, 0.000587019, 0.000320645)),
)

FLANGE_LINK = "bracelet_link"
FLANGE_POSITION: Vector = (0.0, 0.0, -0.061525)  # [table] the "pinch site"; its z points out of the flange
FLANGE_QUATERNION: Quaternion = (0.0, 1.0, 0.0, 0.0)
MARGIN = math.radians(3.0)
"""How near to a joint's limit a path may lead [rad]: the torques of a touch and its friction turn a joint less far from
its desired angle, and a joint at its stop does not read them."""
HOME = (0.0, 0.2618, 3.1416, -2.2689, 0.0, 0.9599, 1.5708)  # rad [table]


@dataclass(frozen=True)
class LinkCapsule:
    """A capsule fixed to a link."""

    link: str
    """Name of the body."""
    start: Vector
    """Centre of one half-sphere in the link's frame (3,) [m]."""
    stop: Vector
    """Centre of the other half-sphere in the link's frame (3,) [m]."""
    radius: float
    """Radius [m]."""


LARGE = 0.046  # [mesh] radius of the housings of joints 1 to 4 [m]
SMALL = 0.035  # [mesh] radius of the housings of joints 5 to 7 [m]
UPPER_WAIST = 0.029  # [mesh] 72 x 39 mm at the thinnest of the two half arms; the ellipse of equal perimeter [m]
FOREARM_WAIST = 0.026  # [mesh] 61 x 42 mm at the thinnest of the forearm [m]

CAPSULES = (
    # The fit. By [mesh] the housings are round, of radius LARGE or SMALL, and their flat faces are 0.0555 m (large) and
    # about 0.045 m (small) from the link's frame along the joint's axis. Between two housings a link narrows on the
    # inner side of the elbow, while its back stays straight. So each housing is a capsule of its radius whose cap
    # touches the flat face, and each waist is one of equal girth that touches the back. A cap removes up to 19 mm of
    # the rim of a housing, but nothing of its girth. The base does not move, so contact on it has no joint torque, and
    # one capsule about its column suffices.
    LinkCapsule("base_link", (0.0, 0.0, 0.050), (0.0, 0.0, 0.115), 0.050),
    LinkCapsule("shoulder_link", (0.0, 0.0, -0.020), (0.0, -0.003, -0.128375), LARGE),
    LinkCapsule("half_arm_1_link", (0.0, 0.0, -0.0095), (0.0, -0.020, -0.0095), LARGE),
    LinkCapsule("half_arm_1_link", (0.0, -0.030, -0.024), (0.0, -0.140, -0.020), UPPER_WAIST),
    LinkCapsule("half_arm_1_link", (0.0, -0.160, -0.006375), (0.0, -0.194, -0.006375), LARGE),
    LinkCapsule("half_arm_2_link", (0.0, 0.0, -0.016), (0.0, 0.0, -0.050), LARGE),
    LinkCapsule("half_arm_2_link", (0.0, -0.017, -0.070), (0.0, -0.020, -0.180), UPPER_WAIST),
    LinkCapsule("half_arm_2_link", (0.0, -0.003, -0.190), (0.0, -0.003, -0.21038), LARGE),
    LinkCapsule("forearm_link", (0.0, 0.0, -0.0095), (0.0, -0.020, -0.0095), LARGE),
    LinkCapsule("forearm_link", (0.0, -0.045, -0.0235), (0.0, -0.135, -0.0165), FOREARM_WAIST),
    LinkCapsule("forearm_link", (0.0, -0.150, -0.0080), (0.0, -0.194, -0.006375), SMALL),
    LinkCapsule("spherical_wrist_1_link", (0.0, 0.0, -0.0145), (0.0, 0.0, -0.040), SMALL),
    LinkCapsule("spherical_wrist_1_link", (0.0, -0.010, -0.070), (0.0, -0.010, -0.105925), SMALL),
    LinkCapsule("spherical_wrist_2_link", (0.0, 0.0, -0.010), (0.0, -0.035, -0.010), SMALL),
    LinkCapsule("spherical_wrist_2_link", (0.0, -0.060, -0.000175), (0.0, -0.0915, -0.000175), SMALL),
    LinkCapsule("bracelet_link", (0.0, 0.0, -0.0145), (0.0, 0.0, -0.0265), SMALL),
    # the housing of the camera, 91 x 27 x 14 mm across the bracelet, and the neck that carries it
    LinkCapsule("bracelet_link", (0.0, -0.020, -0.0480), (0.0, -0.050, -0.0480), 0.0135),
    LinkCapsule("bracelet_link", (-0.032, -0.0608, -0.0495), (0.032, -0.0608, -0.0495), 0.0135),
)

# The Punyo [openvsf]. Its own frame is that of the camera inside.
# rows of its rotation in the flange's frame
PUNYO_ROTATION = ((0.0, -1.0, 0.0), (0.34202, 0.0, -0.93969), (0.93969, 0.0, 0.34202))
PUNYO_POSITION: Vector = (0.0, 0.02111, 0.096142)  # m, in the flange's frame
PUNYO_RIM_CENTRE: Vector = (0.0157, 0.0, 0.0655)  # m
PUNYO_HEIGHT = 0.0305  # m, of the apex of the dome above the plane of the rim
PUNYO_AXIS: Vector = (-0.39394, 0.0, 0.91914)
PUNYO_LONG_AXIS: Vector = (0.91914, 0.0, 0.39394)  # of the rim's ellipse, 57.25 mm; the short one, 40 mm, is y
PUNYO_MASS = 0.4  # kg, an assumption: neither the housing's drawing nor its weight is published; a tare takes it off
PUNYO_COM: Vector = (0.0, 0.0, 0.035)  # m, an assumption: the middle of the chamber
PUNYO_INERTIA: Vector = (5e-4, 7e-4, 7e-4)  # kg m^2, that of a block of 0.11 x 0.08 x 0.09 m of the mass
_DOME = 0.038  # m: 30.5 mm above the rim's plane, and 37 x 56 mm wide in it, where the rim has 40 x 57
_DEEP, _HALF = PUNYO_HEIGHT - _DOME, 0.05725 - _DOME


def _on_dome(side: float) -> Vector:
    return tuple(c + _DEEP * a + side * _HALF * e  # type: ignore[return-value]
                 for c, a, e in zip(PUNYO_RIM_CENTRE, PUNYO_AXIS, PUNYO_LONG_AXIS, strict=True))


PUNYO_CAPSULES = (
    # a rigid stand-in for the free dome; the bubble's own model computes its deformation
    LinkCapsule("punyo", _on_dome(-1.0), _on_dome(1.0), _DOME),
    # the chamber between flange and dome: an assumption, see PUNYO_MASS
    LinkCapsule("punyo", (-0.072, 0.0, -0.008), (0.010, 0.0, 0.030), 0.032),
)
