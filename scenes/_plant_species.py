"""Species-like presets of plants, and the allowed range of every parameter. A new plant is a new row of `SPECIES`.

Sizes and materials are chosen to differ as those of artificial and potted plants do; they are not measured on any
species.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from vsfsim.core.table import between

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


_BROWN, _GREY, _TAN, _CANE = (0.19, 0.10, 0.05), (0.25, 0.23, 0.20), (0.38, 0.27, 0.15), (0.34, 0.36, 0.12)
_DARK, _MID, _LIGHT = (0.04, 0.16, 0.03), (0.08, 0.28, 0.05), (0.20, 0.42, 0.08)
_OLIVE, _BLUE = (0.22, 0.27, 0.14), (0.08, 0.22, 0.14)

SPECIES: dict[str, Species] = {
    "orange-tree": Species(0.55, 1, 0.0, 0.05, 0.009, 0.5, 0.0,
                           (Level(6, 0.4, 1.0, 0.9, 0.45, 0.6), Level(2, 0.4, 1.0, 0.8, 0.5, 0.6)),
                           Leaves(3, 0.3, 0.9, (0.015, 0.0010), (0.07, 0.035, 0.0004)), (2e9, 1e10), (5e8, 3e9),
                           (1e7, 1e8), (3e6, 3e7), _BROWN, _DARK, "grain", (0.09, 0.14)),
    "olive": Species(0.60, 1, 0.0, 0.15, 0.010, 0.4, 0.0, (Level(7, 0.35, 1.0, 0.8, 0.5, 0.45),
                                                           Level(2, 0.3, 0.9, 0.6, 0.45, 0.6)),
                     Leaves(4, 0.2, 0.7, (0.006, 0.0007), (0.05, 0.011, 0.0005)), (3e9, 1e10), (8e8, 5e9), (2e7, 1e8),
                     (1e7, 5e7), _GREY, _OLIVE, "grain", (0.08, 0.12)),
    "weeping-fig": Species(0.70, 1, 0.0, 0.05, 0.008, 0.4, 0.0, (Level(8, 0.3, 1.0, 1.0, 0.45, 0.5, 0.4, 3.0),),
                           Leaves(5, 0.25, 0.7, (0.02, 0.0008), (0.07, 0.03, 0.0003), 5.0), (1e9, 6e9), (1e8, 1e9),
                           (5e6, 5e7), (2e6, 2e7), _TAN, _MID, "stripes", (0.10, 0.15)),
    "rubber-plant": Species(0.60, 1, 0.0, 0.04, 0.008, 0.6, 0.0, (),
                            Leaves(13, 0.2, 0.9, (0.05, 0.0022), (0.19, 0.10, 0.0009), 3.0), (5e8, 3e9), (3e8, 1e9),
                            (2e7, 1e8), (1e7, 6e7), _BROWN, _DARK, "grain", (0.10, 0.16)),
    "monstera": Species(0.12, 1, 0.0, 0.05, 0.013, 0.8, 0.0, (Level(9, 0.2, 1.0, 0.7, 3.2, 0.36, 0.6, 2.0),),
                        Leaves(1, 1.0, 0.7, (0.02, 0.0025), (0.20, 0.18, 0.0008), 4.0), (3e8, 1e9), (1e8, 6e8),
                        (1e7, 6e7), (5e6, 3e7), _CANE, _MID, "plain", (0.11, 0.16)),
    "dracaena": Species(0.50, 1, 0.0, 0.06, 0.013, 0.8, 0.0, (),
                        Leaves(26, 0.72, 0.8, (0.0, 0.0), (0.27, 0.028, 0.0010), 4.0), (8e8, 4e9), (5e8, 2e9),
                        (5e7, 1e8), (2e7, 9e7), _TAN, _MID, "stripes", (0.10, 0.15)),
    "areca-palm": Species(0.20, 4, 0.03, 0.25, 0.006, 0.8, 0.0, (Level(2, 0.7, 1.0, 0.35, 2.2, 0.6, 0.4, 2.5),),
                          Leaves(8, 0.25, 0.8, (0.004, 0.0009), (0.14, 0.016, 0.0004), 3.0), (5e8, 3e9), (2e8, 1e9),
                          (1e7, 1e8), (5e6, 5e7), _CANE, _LIGHT, "stripes", (0.11, 0.16)),
    "snake-plant": Species(0.02, 10, 0.045, 0.18, 0.012, 0.9, 0.0, (),
                           Leaves(1, 1.0, 0.02, (0.0, 0.0), (0.40, 0.05, 0.0035), 0.3), (3e8, 1e9), (3e8, 1e9),
                           (1e8, 2e8), (3e7, 2e8), _CANE, _BLUE, "stripes", (0.10, 0.14)),
    "bamboo": Species(0.90, 4, 0.03, 0.10, 0.006, 0.6, 0.0, (Level(4, 0.35, 1.0, 0.7, 0.22, 0.4, 0.5, 1.0),),
                      Leaves(4, 0.3, 0.6, (0.004, 0.0007), (0.09, 0.012, 0.0003), 3.0), (4e9, 1e10), (1e9, 4e9),
                      (1e7, 1e8), (5e6, 5e7), _CANE, _LIGHT, "plain", (0.10, 0.16)),
    "umbrella-tree": Species(0.45, 2, 0.02, 0.15, 0.008, 0.6, 0.0, (Level(6, 0.4, 1.0, 0.9, 0.5, 0.35, 0.7, 1.5),),
                             Leaves(6, 0.98, 1.1, (0.012, 0.0009), (0.09, 0.035, 0.0005), 2.0), (5e8, 3e9), (1e8, 8e8),
                             (1e7, 6e7), (5e6, 4e7), _GREY, _MID, "noise", (0.10, 0.14)),
    "rosemary": Species(0.34, 10, 0.05, 0.35, 0.0032, 0.4, 0.0, (Level(2, 0.3, 0.8, 0.5, 0.5, 0.7),),
                        Leaves(5, 0.2, 0.7, (0.0, 0.0), (0.026, 0.004, 0.0006), 0.0), (1e9, 6e9), (3e8, 2e9),
                        (5e7, 1e8), (2e7, 9e7), _BROWN, _BLUE, "grain", (0.09, 0.12)),
    "bonsai-pine": Species(0.28, 1, 0.0, 0.3, 0.016, 0.35, 0.0,
                           (Level(6, 0.35, 1.0, 1.2, 0.6, 0.4, 0.5, -1.5), Level(3, 0.4, 1.0, 0.6, 0.4, 0.5)),
                           Leaves(5, 0.6, 0.8, (0.0, 0.0), (0.035, 0.004, 0.0007), 0.0), (3e9, 1e10), (1e9, 5e9),
                           (5e7, 1e8), (3e7, 1e8), _BROWN, _DARK, "grain", (0.12, 0.09)),
}


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
