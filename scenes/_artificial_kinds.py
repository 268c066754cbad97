"""Kinds of artificial potted plants, the 24 named plants made of them, and the parameters of the family.

Sizes follow the sourced figures of docs/plants.md: florist wire of 0.4 to 1.3 mm in leaves, petioles and twigs, rods of
2 to 5 mm in branches and stems, a sheath of soft plastic around them, trunks of natural wood, a nursery pot whose
filling lets the trunk tilt. Which wire a factory puts into which part is not published; the assignment is ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from vsfsim.core.table import between

REGIONS = ("joint", "trunk", "branch", "petiole", "leaf")
JOINT, TRUNK, BRANCH, PETIOLE, LEAF = range(5)


@dataclass(frozen=True)
class Stalk:
    """A round part: a core of steel wire in a sheath, or solid where the wire is 0."""

    length: float
    """[m]"""
    diameter: float
    """Outer diameter at the base [m]."""
    wire: float
    """Diameter of the core over the outer diameter at the base [-]; 0: solid wood."""
    taper: float = 0.75
    """Outer diameter at the tip over that at the base [-]; the wire keeps its diameter."""
    droop: float = 0.0
    """Downward curvature [1/m]; a negative one bends upwards."""


@dataclass(frozen=True)
class Level:
    """Stalks that grow on the axes of the previous level."""

    count: int
    """Number on each axis."""
    start: float
    """First place along the axis, as a fraction of its length; the last place is its end."""
    angle: float
    """Angle from the axis [rad]."""
    stalk: Stalk
    """What grows there."""


@dataclass(frozen=True)
class Leaves:
    """Leaves of an axis of the last level."""

    count: int
    """Number on each axis."""
    start: float
    """First place along the axis, as a fraction of its length."""
    angle: float
    """Angle from the axis [rad]."""
    petiole: Stalk | None
    """None for a blade that sits on the axis."""
    blade: tuple[float, float, float]
    """Length, width and thickness of the blade [m]."""
    midrib: float
    """Diameter of the wire in the blade [m]."""
    droop: float = 2.0
    """Downward curvature of the blade [1/m]."""


@dataclass(frozen=True)
class Kind:
    """A kind of plant."""

    stems: int
    """Number of stems."""
    spread: float
    """Distance of the stems' feet from the pot's axis [m]."""
    lean: float
    """Largest angle of a stem from upright [rad]."""
    stem: Stalk
    """Each stem."""
    levels: tuple[Level, ...]
    """Branches."""
    leaves: Leaves
    """Leaves."""
    joint: tuple[float, float]
    """Bounds of the rotational stiffness of the pot's filling around a stem, log-uniform [N m/rad]."""
    bark: tuple[float, float, float]
    """Colour of stems and branches, linear RGB, 0 to 1."""
    foliage: tuple[float, float, float]
    """Colour of leaves, linear RGB, 0 to 1."""
    texture: str
    """Texture of the bark, one of `vsfsim.core.solid.TEXTURES`."""
    pot: tuple[float, float]
    """Radius and height of the pot [m]."""


_BROWN, _GREY, _TAN, _CANE = (0.19, 0.10, 0.05), (0.25, 0.23, 0.20), (0.38, 0.27, 0.15), (0.34, 0.36, 0.12)
_DARK, _MID, _LIGHT = (0.04, 0.16, 0.03), (0.08, 0.28, 0.05), (0.20, 0.42, 0.08)
_OLIVE, _BLUE = (0.22, 0.27, 0.14), (0.08, 0.22, 0.14)
_TRUNK_JOINT, _STEM_JOINT = (30.0, 100.0), (12.0, 40.0)

KINDS: dict[str, Kind] = {
    "orange-tree": Kind(1, 0.0, 0.05, Stalk(0.42, 0.022, 0.0, 0.6),
                        (Level(6, 0.45, 0.85, Stalk(0.25, 0.0092, 0.43)),
                         Level(3, 0.3, 0.75, Stalk(0.14, 0.0048, 0.41))),
                        Leaves(14, 0.2, 0.9, Stalk(0.015, 0.0025, 0.41), (0.070, 0.036, 0.0006), 0.0009),
                        _TRUNK_JOINT, _BROWN, _DARK, "grain", (0.085, 0.13)),
    "olive-tree": Kind(1, 0.0, 0.12, Stalk(0.45, 0.020, 0.0, 0.6),
                       (Level(7, 0.35, 0.8, Stalk(0.25, 0.0080, 0.43)),
                        Level(3, 0.3, 0.6, Stalk(0.15, 0.0042, 0.39))),
                       Leaves(12, 0.1, 0.7, None, (0.060, 0.014, 0.0006), 0.0009),
                       _TRUNK_JOINT, _GREY, _OLIVE, "grain", (0.08, 0.12)),
    "weeping-fig": Kind(1, 0.0, 0.06, Stalk(0.52, 0.018, 0.0, 0.55),
                        (Level(9, 0.3, 1.0, Stalk(0.26, 0.0088, 0.43, 0.7, 2.5)),
                         Level(2, 0.4, 0.7, Stalk(0.13, 0.0047, 0.41, 0.7, 4.0))),
                        Leaves(14, 0.1, 0.7, Stalk(0.018, 0.0023, 0.41), (0.070, 0.030, 0.0005), 0.0009, 5.0),
                        _TRUNK_JOINT, _TAN, _MID, "stripes", (0.095, 0.14)),
    "rubber-plant": Kind(3, 0.03, 0.18, Stalk(0.48, 0.014, 0.43, 0.75), (),
                         Leaves(14, 0.12, 0.9, Stalk(0.05, 0.0058, 0.43), (0.19, 0.10, 0.0010), 0.0021, 3.0),
                         _TRUNK_JOINT, _BROWN, _DARK, "grain", (0.095, 0.15)),
    "fiddle-leaf-fig": Kind(1, 0.0, 0.06, Stalk(0.50, 0.019, 0.0, 0.6),
                            (Level(5, 0.45, 0.6, Stalk(0.20, 0.0095, 0.43)),),
                            Leaves(8, 0.15, 0.8, Stalk(0.03, 0.0052, 0.43), (0.18, 0.12, 0.0010), 0.0021, 2.0),
                            _TRUNK_JOINT, _TAN, _MID, "grain", (0.10, 0.15)),
    "monstera": Kind(1, 0.0, 0.05, Stalk(0.10, 0.024, 0.3, 0.9),
                     (Level(14, 0.1, 0.42, Stalk(0.33, 0.0115, 0.45, 0.7, 1.0)),),
                     Leaves(1, 1.0, 0.7, Stalk(0.03, 0.0060, 0.43), (0.17, 0.15, 0.0010), 0.0024, 4.0),
                     _TRUNK_JOINT, _CANE, _MID, "plain", (0.105, 0.15)),
    "dracaena": Kind(3, 0.03, 0.08, Stalk(0.42, 0.022, 0.0, 0.9), (),
                     Leaves(30, 0.70, 0.8, None, (0.28, 0.028, 0.0012), 0.0021, 3.0),
                     _TRUNK_JOINT, _TAN, _MID, "stripes", (0.095, 0.14)),
    "areca-palm": Kind(8, 0.035, 0.30, Stalk(0.60, 0.0130, 0.45, 0.7, 0.6), (),
                       Leaves(40, 0.30, 0.8, None, (0.17, 0.018, 0.0006), 0.0011, 3.0),
                       _STEM_JOINT, _CANE, _LIGHT, "stripes", (0.10, 0.15)),
    "snake-plant": Kind(10, 0.05, 0.20, Stalk(0.03, 0.018, 0.3, 0.9), (),
                        Leaves(1, 1.0, 0.02, None, (0.48, 0.055, 0.0040), 0.0028, 0.2),
                        _STEM_JOINT, _CANE, _BLUE, "stripes", (0.09, 0.13)),
    "bamboo": Kind(6, 0.035, 0.10, Stalk(0.70, 0.0145, 0.45, 0.7),
                   (Level(7, 0.25, 0.7, Stalk(0.14, 0.0050, 0.41, 0.8, 1.0)),),
                   Leaves(12, 0.15, 0.6, None, (0.10, 0.016, 0.0006), 0.0009, 3.0),
                   _STEM_JOINT, _CANE, _LIGHT, "plain", (0.095, 0.15)),
    "umbrella-tree": Kind(4, 0.03, 0.20, Stalk(0.44, 0.0120, 0.45, 0.75),
                          (Level(7, 0.25, 0.9, Stalk(0.16, 0.0052, 0.43, 0.8, 1.5)),),
                          Leaves(7, 0.98, 1.1, Stalk(0.012, 0.0026, 0.43), (0.10, 0.042, 0.0006), 0.0010),
                          _STEM_JOINT, _GREY, _MID, "noise", (0.095, 0.13)),
    "bonsai-pine": Kind(1, 0.0, 0.3, Stalk(0.30, 0.026, 0.0, 0.5),
                        (Level(7, 0.3, 1.2, Stalk(0.19, 0.0080, 0.41, 0.7, -1.5)),
                         Level(4, 0.3, 0.7, Stalk(0.09, 0.0040, 0.39))),
                        Leaves(6, 0.3, 0.9, None, (0.045, 0.010, 0.0010), 0.0008, 0.0),
                        _TRUNK_JOINT, _BROWN, _DARK, "grain", (0.11, 0.09)),
    "boxwood": Kind(8, 0.045, 0.35, Stalk(0.32, 0.0070, 0.43, 0.75),
                    (Level(5, 0.25, 0.7, Stalk(0.14, 0.0040, 0.41)),),
                    Leaves(10, 0.1, 0.9, None, (0.034, 0.018, 0.0007), 0.0008, 1.0),
                    _STEM_JOINT, _BROWN, _LIGHT, "grain", (0.09, 0.12)),
}


@dataclass(frozen=True)
class Named:
    """A plant that can be asked for by name."""

    kind: str
    """A key of `KINDS`."""
    size: float
    """Factor on the lengths of stems and branches [-]."""
    girth: float
    """Factor on the diameters of stems, branches and petioles [-]."""
    leaf: float
    """Factor on length and width of the blades [-]."""
    dense: float
    """Factor on the number of leaves and of branches [-]."""


PLANTS: dict[str, Named] = {
    "orange-tree": Named("orange-tree", 1.0, 1.0, 1.0, 1.0),
    "olive-tree": Named("olive-tree", 1.0, 1.0, 1.0, 1.0),
    "rubber-plant": Named("rubber-plant", 1.0, 1.0, 1.0, 1.0),
    "areca-palm": Named("areca-palm", 1.0, 1.0, 1.0, 1.0),
    "weeping-fig": Named("weeping-fig", 1.0, 1.0, 1.0, 1.0),
    "monstera": Named("monstera", 1.0, 1.0, 1.0, 1.0),
    "bamboo": Named("bamboo", 1.0, 1.0, 1.0, 1.0),
    "umbrella-tree": Named("umbrella-tree", 1.0, 1.0, 1.0, 1.0),
    "dracaena": Named("dracaena", 1.0, 1.0, 1.0, 1.0),
    "fiddle-leaf-fig": Named("fiddle-leaf-fig", 1.0, 1.0, 1.0, 1.0),
    "boxwood": Named("boxwood", 1.0, 1.0, 1.0, 1.0),
    "bonsai-pine": Named("bonsai-pine", 1.0, 1.0, 1.0, 1.0),
    "orange-tree-small": Named("orange-tree", 0.8, 0.85, 0.9, 1.2),
    "olive-tree-tall": Named("olive-tree", 1.15, 1.2, 1.1, 0.85),
    "rubber-plant-broad": Named("rubber-plant", 0.9, 1.15, 1.15, 0.8),
    "areca-palm-small": Named("areca-palm", 0.8, 0.85, 0.85, 1.15),
    "weeping-fig-dense": Named("weeping-fig", 0.9, 1.1, 0.9, 1.25),
    "monstera-small": Named("monstera", 0.85, 0.85, 0.8, 1.2),
    "bamboo-slender": Named("bamboo", 1.1, 0.85, 1.1, 0.9),
    "umbrella-tree-tall": Named("umbrella-tree", 1.2, 1.1, 1.0, 0.9),
    "dracaena-narrow": Named("dracaena", 1.15, 0.9, 0.9, 1.1),
    "fiddle-leaf-fig-young": Named("fiddle-leaf-fig", 0.8, 0.85, 0.85, 0.9),
    "boxwood-round": Named("boxwood", 0.85, 1.15, 1.1, 1.2),
    "snake-plant": Named("snake-plant", 1.0, 1.0, 1.0, 1.0),
}


@dataclass(frozen=True)
class Options:
    """The parameters of the family."""

    plant: Literal[(*PLANTS, "by-object", "random")] = "by-object"
    """A key of `PLANTS`; "by-object" for the first name for object 0 of a dataset, the second for object 1, and so on;
    or "random" for a random one with every size drawn anew."""
    variation: Annotated[float, between(0.0, 0.5)] = 0.1
    """Largest relative deviation of a size from the named plant's [-]."""
    wood_segments: Annotated[int, between(10, 1000, whole=True)] = 160
    """Largest number of segments of stems and branches; longer segments, not fewer branches, keep to it."""
    leaf_segments: Annotated[int, between(0, 2000, whole=True)] = 260
    """Largest number of segments of petioles and blades; the plant has only as many leaves as this allows."""
    size: Annotated[float, between(0.3, 2.0)] = 1.0
    """Factor on the lengths of stems and branches; diameters and leaves keep theirs [-]."""
    girth: Annotated[float, between(0.5, 2.0)] = 1.0
    """Factor on the diameters of stems, branches, petioles and midribs, and so on those of their wires [-]."""
    leaves: Annotated[float, between(0.1, 5.0)] = 1.0
    """Factor on the number of leaves of an axis [-]."""
    segment: Annotated[float, between(0.002, 0.1)] = 0.025
    """Least length of the segments of stems and branches [m]."""
    yields: bool = False
    """Whether wires yield; they are elastic otherwise."""


def name_of(options: Options, pick: int, index: int) -> str:
    """The name of object ``index``; ``pick`` is a random number from 0 to ``len(PLANTS)`` - 1."""
    names = tuple(PLANTS)
    if options.plant == "random":
        return names[pick]
    return names[index % len(names)] if options.plant == "by-object" else options.plant
