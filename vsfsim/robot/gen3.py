"""The Kinova Gen3 (7 joints), whose bodies and capsules are `gen3.xml`, and the numbers of the Punyo on its flange.

Mount and frame of the Punyo are those of openvsf. Its own frame is that of the camera inside.
"""

from __future__ import annotations

import math
from pathlib import Path

Vector = tuple[float, float, float]

MODEL = Path(__file__).with_name("gen3.xml")
"""MuJoCo's description of the arm, with the sources of its numbers."""
JOINTS = 7
MARGIN = math.radians(3.0)
"""How near to a joint's limit a path may lead [rad]: the torques of a touch and its friction turn a joint less far from
its desired angle, and a joint at its stop does not read them."""
HOME = (0.0, 0.2618, 3.1416, -2.2689, 0.0, 0.9599, 1.5708)
"""Joint angles of the maker's home posture [rad]."""

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
    (_on_dome(-1.0), _on_dome(1.0), _DOME),
    # the chamber between flange and dome: an assumption, see PUNYO_MASS
    ((-0.072, 0.0, -0.008), (0.010, 0.0, 0.030), 0.032),
)
"""Centres of both half-spheres (3,) [m] and radius [m] of its capsules."""
