"""Species-like presets of plants, and the allowed range of every parameter. A new plant is a new table of
`tables/plant_species.toml`.

Sizes and materials are chosen to differ as those of artificial and potted plants do; they are not measured on any
species.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from vsfsim.core.table import between, shipped_rows

REGIONS = ("trunk", "branch", "petiole", "leaf")
TRUNK, BRANCH, PETIOLE, LEAF = range(4)


@dataclass(frozen=True)
class Level:
    """Branches that grow on the axes of the previous level, the bearing axes."""

    count: int
    """Number on each axis."""
    start: float
    """First place along the axis, as a fraction of its length."""
    end: float
    """Last place along the axis, as a fraction of its length."""
    angle: float
    """Angle from the axis [rad]."""
    length: float
    """Length, as a fraction of the bearing axis's length [-]."""
    radius: float
    """Radius at the base, as a fraction of the bearing axis's radius there [-]."""
    taper: float = 0.5
    """Ratio of the radius at the tip to that at the base [-]."""
    droop: float = 0.0
    """Downward curvature [1/m]; a negative one bends upwards."""


@dataclass(frozen=True)
class Leaves:
    """Leaves of an axis of the last level."""

    count: int
    """Number on each axis."""
    start: float
    """First place along the axis, as a fraction of its length."""
    angle: float
    """Angle from the axis [rad]."""
    petiole: tuple[float, float]
    """Length and radius of the petiole [m]; length 0 for none."""
    blade: tuple[float, float, float]
    """Length, width and thickness of the blade [m]."""
    droop: float = 2.0
    """Downward curvature of the blade [1/m]."""


@dataclass(frozen=True)
class Species:
    """A kind of plant."""

    height: float
    """Height of the stems [m]."""
    stems: int
    """Number of stems."""
    spread: float
    """Distance of the stems' feet [m]."""
    lean: float
    """Angle of the stems from upright [rad]."""
    radius: float
    """Radius of a stem at its foot [m]."""
    taper: float
    """Ratio of a stem's radius at its tip to that at its foot [-]."""
    droop: float
    """Downward curvature of the stems [1/m]."""
    levels: tuple[Level, ...]
    """Levels of branches."""
    leaves: Leaves
    """The leaves."""
    wood: tuple[float, float]
    """Bounds of Young's modulus of stems, whose distribution is log-uniform [Pa]."""
    shoot: tuple[float, float]
    """The same for branches [Pa]."""
    petiole: tuple[float, float]
    """The same for petioles [Pa]."""
    leaf: tuple[float, float]
    """The same for blades [Pa]."""
    bark: tuple[float, float, float]
    """Usual colour of stems and branches, linear RGB, 0 to 1."""
    foliage: tuple[float, float, float]
    """Usual colour of leaves, linear RGB, 0 to 1."""
    texture: str
    """Texture of the bark, one of `vsfsim.core.solid.TEXTURES`."""
    pot: tuple[float, float]
    """Radius and height of the pot [m]."""


SPECIES: dict[str, Species] = shipped_rows(__file__, "tables/plant_species.toml", Species)


@dataclass(frozen=True)
class PlantOptions:
    """The parameters of a plant."""

    species: Literal[(*SPECIES, "random", "by-object")] = "random"
    """A key of `SPECIES`; "random" for a random one with every size drawn within a factor of 1.5; or "by-object" for
    the first species for object 0 of a dataset, the second for object 1, and so on."""
    scale: Annotated[float, between(0.2, 2.0)] = 1.0
    """Factor on all lengths [-]."""
    variation: Annotated[float, between(0.0, 0.5)] = 0.15
    """Largest relative deviation of a size from the species' value [-]."""
    leaf_share: Annotated[float, between(0.0, 1.0)] = 1.0
    """Fraction of the leaves that grow [-]."""
    max_segments: Annotated[int, between(3, 2000, whole=True)] = 500
    """Largest number of segments; the plant has only as many leaves as this allows."""
    appearance_informative: Annotated[float, between(0.0, 1.0)] = 0.8
    """Probability that a part's appearance depends on its own stiffness [-]."""
    leaves: bool = True
    """Whether the plant has leaves."""
    modulus_factor: Annotated[float, between(1e-6, 1e3)] = 1.0
    """Factor on all moduli [-]."""
    segment: Annotated[float, between(0.002, 0.1)] = 0.02
    """Length of the segments of stems and branches [m]."""


def drawn(options: PlantOptions, rng: np.random.Generator, index: int) -> tuple[str, Species]:
    """Name and species of object ``index``, with random sizes. The number of draws does not depend on the outcome."""
    names = tuple(SPECIES)
    pick, wild = int(rng.integers(len(names))), options.species == "random"
    name = names[pick] if wild else names[index % len(names)] if options.species == "by-object" else options.species
    kind = SPECIES[name]
    spread = np.log(1.5) if wild else np.log1p(options.variation)
    f = np.exp(spread * rng.uniform(-1.0, 1.0, 8))
    s = options.scale
    levels = tuple(replace(level, count=max(1, round(level.count * f[0])), angle=level.angle * f[1]
                           ** 0.5, length=level.length * f[2]) for level in kind.levels)
    length, radius = kind.leaves.petiole
    blade = kind.leaves.blade
    leaves = replace(kind.leaves, count=max(1, round(kind.leaves.count * f[3])),
                     petiole=(s * length * f[4], s * radius),
                     blade=(s * blade[0] * f[5], s * blade[1] * f[5], s * blade[2]))
    kind = replace(kind, height=s * kind.height * f[6], spread=s * kind.spread, radius=s * kind.radius * f[7],
                   levels=levels, leaves=leaves, pot=(s * kind.pot[0], s * kind.pot[1]))
    return name, kind
