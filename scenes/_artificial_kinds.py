"""Kinds of artificial potted plants (`tables/artificial_kinds.toml`), the 24 named plants made of them
(`tables/artificial_plants.toml`), and the parameters of the family.

Sizes follow the sourced figures of docs/plants.md: florist wire of 0.4 to 1.3 mm in leaves, petioles and twigs, rods of
2 to 5 mm in branches and stems, a sheath of soft plastic around them, trunks of natural wood, a nursery pot whose
filling lets the trunk tilt. Which wire a factory puts into which part is not published; the assignment is ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from vsfsim.core.table import between, shipped_rows

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
    blade: tuple[float, float, float]
    """Length, width and thickness of the blade [m]."""
    midrib: float
    """Diameter of the wire in the blade [m]."""
    petiole: Stalk | None = None
    """None for a blade that sits on the axis."""
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


KINDS: dict[str, Kind] = shipped_rows(__file__, "tables/artificial_kinds.toml", Kind)


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


PLANTS: dict[str, Named] = shipped_rows(__file__, "tables/artificial_plants.toml", Named)


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
    fixed: bool = False
    """Whether stems are clamped in the pot, as in the papers' experiments; otherwise the pot's filling gives way."""


def name_of(options: Options, pick: int, index: int) -> str:
    """The name of object ``index``; ``pick`` is a random number from 0 to ``len(PLANTS)`` - 1."""
    names = tuple(PLANTS)
    if options.plant == "random":
        return names[pick]
    return names[index % len(names)] if options.plant == "by-object" else options.plant
