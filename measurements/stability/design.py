"""The design of the stability map: which presses are made, as a stated and seeded list of cells.

A cell is one press. It has a value of every factor of its kind. Three kinds are made:

- solid: a block that stands on its base, pressed by a rigid body (`SOLID` states factors, levels and defaults);
- bubble: the air-filled sensor against rigid bodies, and against a block (`BUBBLE`);
- rod: a clamped upright stem bent by a capsule (`ROD`).

Solids come in three groups. "one factor" changes one factor from its default through all its levels. "pair" takes the
two outermost levels of every pair of numerical factors together. "random" draws every factor from its levels, half of
the draws the default, with the seed of the design. Bubbles and rods have the groups "one factor" and "random".
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

Level = float | str
"""A value of a factor."""


@dataclass(frozen=True)
class Factor:
    """One quantity of a press that the design changes."""

    name: str
    unit: str
    """SI, "1" for a number without one, empty for a choice."""
    default: Level
    levels: Sequence[Level]
    """All values, the default among them; numbers increase."""


SOLID = (
    Factor("contrast", "1", 1.0, (1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6, 1e7, 1e8)),
    Factor("young", "Pa", 1e5, (1e2, 1e3, 1e5, 1e7, 1e9, 1e11)),
    Factor("poisson", "1", 0.45, (0.0, 0.1, 0.3, 0.45, 0.49, 0.499, 0.4999)),
    Factor("depth", "1", 0.15, (0.01, 0.05, 0.15, 0.3, 0.5, 0.7, 0.9)),
    Factor("element", "1", 1.0, (0.5, 0.7, 1.0, 1.4, 2.0)),
    Factor("size", "m", 0.04, (0.001, 0.01, 0.04, 0.1, 1.0, 10.0)),
    Factor("thickness", "1", 0.5, (0.025, 0.1, 0.25, 0.5, 1.0, 3.0)),
    Factor("friction", "1", 0.0, (0.0, 0.2, 0.5, 1.0, 2.0, 10.0)),
    Factor("gravity", "m/s^2", 0.0, (0.0, 9.81, 98.1)),
    Factor("frames", "1", 4.0, (1.0, 2.0, 4.0, 12.0)),
    Factor("probe", "", "ball", ("ball", "small ball", "box", "box edge", "box corner", "cylinder", "cylinder rim",
                                 "capsule", "capsule end", "plane", "fork", "ball and wall", "pyramid")),
    Factor("precision", "", "float64", ("float64", "float32")),
    Factor("tier", "", "fem-coarse", ("vsf", "spring", "linear", "fem-coarse", "fem", "fem-fine")),
)
"""Contrast: modulus of a ball inside over that of the block. Depth: over the block's height. Element: factor on the
element size of the tier. Size: width of the block. Thickness: height over width."""
BUBBLE = (
    Factor("against", "", "tip", ("tip", "small ball", "ball", "plane", "box corner", "box edge", "cylinder rim",
                                  "soft block", "block")),
    Factor("depth", "1", 0.2, (0.03, 0.2, 0.4, 0.66)),
    Factor("friction", "1", 0.0, (0.0, 0.5, 2.0)),
    Factor("gauge", "Pa", 7820.0, (1.0, 300.0, 3000.0, 7820.0)),
    Factor("stretch", "1", 1.1, (1.05, 1.1, 1.5)),
    Factor("move", "", "press", ("press", "drag", "twist")),
    Factor("nodes", "1", 390.0, (390.0, 1500.0)),
    Factor("frames", "1", 4.0, (1.0, 4.0)),
)
"""Against: rigid bodies, or a block of 1 kPa (soft) or 100 kPa. The tip is a rod of 6 mm with a round end; the small
ball has its radius, and nothing behind it. Depth: over the height of the free dome (30.4 mm by default, 1.6 mm at
300 Pa, 5 um at 1 Pa), because behind the plane of the rim is the housing, which no body can enter. Gauge: pressure of
the gas over that around it. Drag: 10 mm sideways after the press; twist: 45 degrees about the mount's axis."""
ROD = (
    Factor("young", "Pa", 1e9, (1e5, 1e7, 1e9, 1e11)),
    Factor("slender", "1", 0.01, (0.001, 0.003, 0.01, 0.05)),
    Factor("depth", "1", 0.15, (0.02, 0.15, 0.5, 0.9)),
    Factor("height", "1", 0.7, (0.2, 0.7, 0.95)),
    Factor("friction", "1", 0.0, (0.0, 0.5, 2.0, 10.0)),
    Factor("segments", "1", 15.0, (5.0, 15.0, 60.0)),
    Factor("capsule", "1", 0.1, (0.01, 0.1, 0.3)),
    Factor("frames", "1", 12.0, (2.0, 12.0, 60.0)),
)
"""Slender: radius over length. Depth: way of the capsule past first contact over the length. Height: where it touches,
over the length. Capsule: its radius over the length."""
INSTEAD: Mapping[Level, Level] = {"float32": "float64", "spring": "fem-coarse"}
"""What a cell has in place of a level that the simulator does not have: it is drawn, so that a seed keeps its cells."""
STIFFEST = 1e13
"""Largest modulus of a scene [Pa]: a cell whose inclusion would be stiffer is left out."""
KINDS: Mapping[str, Sequence[Factor]] = {"solid": SOLID, "bubble": BUBBLE, "rod": ROD}


@dataclass(frozen=True)
class Cell:
    """One press of the design."""

    kind: str
    group: str
    factors: Mapping[str, Level] = field(hash=False)
    """A value of every factor of its kind."""

    @property
    def key(self) -> str:
        """Twelve hexadecimal digits of the hash of kind and factors: the cell's name in files."""
        return hashlib.sha256(json.dumps([self.kind, dict(sorted(self.factors.items()))]).encode()).hexdigest()[:12]

    @property
    def text(self) -> str:
        """Kind, and the factors that are not at their default."""
        changed = [f"{f.name} {self.factors[f.name]:g}" if isinstance(self.factors[f.name], float)
                   else f"{f.name} {self.factors[f.name]}" for f in KINDS[self.kind]
                   if self.factors[f.name] != f.default]
        return f"{self.kind}: {', '.join(changed) or 'defaults'}"

    @property
    def moderate(self) -> bool:
        """Whether friction is at most 1, and the depth at most half of the body (or of a rod's length, or of a bubble's
        height)."""
        return float(self.factors["friction"]) <= 1.0 and float(self.factors["depth"]) <= 0.5


def design(seed: int = 0, random_solids: int = 230, random_others: int = 40) -> list[Cell]:
    """All cells, none twice, in an order that mixes kinds and groups, so that a part of it represents the whole.

    Args:
        seed: of the random cells and of the order (0 or more).
        random_solids: number of random cells of solids.
        random_others: the same for bubbles, and for rods.
    """
    rng = np.random.default_rng(seed)
    cells: dict[str, Cell] = {}

    def add(kind: str, group: str, **changed: Level) -> None:
        cell = Cell(kind, group, {f.name: changed.get(f.name, f.default) for f in KINDS[kind]})
        if kind != "solid" or float(cell.factors["young"]) * float(cell.factors["contrast"]) <= STIFFEST:
            cells.setdefault(cell.key, cell)

    for kind, factors in KINDS.items():
        for f in factors:
            for level in f.levels:
                add(kind, "one factor", **{f.name: level})
    numbers = [f for f in SOLID if isinstance(f.default, float) and f.name != "frames"]
    for a, b in itertools.combinations(numbers, 2):
        for x, y in itertools.product((a.levels[0], a.levels[-1]), (b.levels[0], b.levels[-1])):
            add("solid", "pair", **{a.name: x, b.name: y})
    for kind, count in (("solid", random_solids), ("bubble", random_others), ("rod", random_others)):
        wanted = len(cells) + count
        while len(cells) < wanted:
            add(kind, "random", **{f.name: f.levels[int(rng.integers(len(f.levels)))] for f in KINDS[kind]
                                   if rng.random() < 0.5})
    drawn = list(cells.values())
    made = [Cell(c.kind, c.group, {name: INSTEAD.get(level, level) for name, level in c.factors.items()})
            for c in (drawn[k] for k in rng.permutation(len(drawn)))]
    return list({cell.key: cell for cell in made}.values())
