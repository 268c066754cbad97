"""Potted plants: stems, branches of tapering radius, petioles and leaf blades, as a tree of beams.

`grow` makes the tree (`vsfsim.core.plant.Plant`). An axis is a chain of segments whose direction varies a little from
one to the next. The axes of the next level, or the leaves, are placed around it at multiples of the golden angle.
Young's modulus is drawn for every axis within its species' range for stems, branches, petioles or leaves, and varies
along the axis.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from vsfsim.core.plant import Plant, Pot
from vsfsim.core.solid import Appearance
from vsfsim.core.table import typed
from vsfsim.scenes import _plant_species as kinds
from vsfsim.scenes._growth import Growth
from vsfsim.scenes._plant_species import BRANCH, LEAF, PETIOLE, REGIONS, TRUNK, PlantOptions, drawn

_MODULUS_SPREAD = 0.15
"""Standard deviation of ln E along an axis [-]."""
_WOOD_DENSITY, _LEAF_DENSITY = 700.0, 600.0
"""Densities of leaf blades (the second) and of all other parts [kg/m^3]."""
_BRIGHTNESS = 0.45
"""Change of the log brightness from the middle to either end of a range of moduli [-]."""


def grow(parameters: Mapping[str, Any], rng: np.random.Generator, *, where: str, number: int = 0) -> Plant:
    """A plant in a pot that stands on z = 0, with the foot of the plant above the origin.

    Args:
        parameters: fields of `_plant_species.PlantOptions`.
        rng: random stream of form, moduli and appearance, in this order.
        where: file and section, for error messages.
        number: of the object in its dataset, from 0.

    Raises:
        SceneError: a parameter is unknown or out of its range.
    """
    options = typed(parameters, PlantOptions, where)
    name, kind = drawn(options, rng, number)
    garden = _Garden(kind, options, rng)
    garden.grow()
    n = len(garden.nodes)
    look = _appearance(garden, kind, options.appearance_informative, rng)
    region = np.array(garden.region)
    return Plant(np.array(garden.nodes), np.array(garden.parent), np.array(garden.radius),
                 np.array(garden.half_width), np.array(garden.normal), np.array(garden.modulus)
                 * options.modulus_factor, np.where(region == LEAF, _LEAF_DENSITY, _WOOD_DENSITY),
                 region, REGIONS, look=np.array(garden.axis), appearance=look,
                 pot=Pot(kind.pot[0], 0.75 * kind.pot[0], kind.pot[1]),
                 notes=(f"{name}: {n - 1} segments, {sum(r == LEAF for r in garden.region[1:])} of "
                        f"them of leaves, {max(p[2] for p in garden.nodes):.2f} m high.",))


class _Garden(Growth):
    """The plant while it grows; of each axis its region and ln of the mean modulus."""

    def __init__(self, kind: kinds.Species, options: PlantOptions, rng: np.random.Generator):
        super().__init__(rng, np.array([0.0, 0.0, kind.pot[1]]), kind.radius)
        self.kind, self.options = kind, options
        self.axes: list[tuple[int, float]] = []

    def grow(self) -> None:
        kind, bearers = self.kind, []
        for way, place in self.stems(kind.stems, kind.spread, kind.lean, 0.002):
            root = 0
            if place is not None:  # a stiff segment in the soil joins every stem to the clamped node
                root = self.node(0, place, max(kind.radius, 0.01), TRUNK, 1e10, self._new_axis(TRUNK, 1e10))
            bearers.append(self._axis_of(root, way, kind.height * self.rng.uniform(0.85, 1.1),
                                         kind.radius, kind.taper, kind.droop, TRUNK, kind.wood))
        for level in kind.levels:
            bearers = [child for axis in bearers for child in self._branches(axis, level)]
        if self.options.leaves:
            self._add_leaves(bearers, kind.leaves)

    def _new_axis(self, region: int, modulus: float) -> int:
        self.axes.append((region, math.log(modulus)))
        return len(self.axes) - 1

    def _varied(self, modulus: float) -> float:
        """The modulus of a segment of an axis."""
        return modulus * math.exp(_MODULUS_SPREAD * self.rng.normal())

    def _axis_of(self, start: int, way: np.ndarray, length: float, radius: float, taper: float, droop: float,
                 region: int, span: tuple[float, float], *, step: float | None = None) -> list[int]:
        """Grow a chain of round segments from node ``start``; its nodes, the start first."""
        count = max(1, round(length / (step or self.options.segment)))
        modulus = self.drawn(span)
        axis = self._new_axis(region, modulus)
        out, at = [start], start
        for k in range(count):
            way, place = self.step(at, way, length, count, droop)
            if place[2] < 0.02:  # nothing grows into the table
                place = np.array([place[0], place[1], 0.02])
                if np.linalg.norm(place - self.nodes[at]) < 0.2 * length / count:
                    break
            thick = radius * (1.0 - (1.0 - taper) * (k + 0.5) / count)
            at = self.node(at, place, thick, region, self._varied(modulus), axis)
            out.append(at)
        return out

    def _branches(self, axis: list[int], level: kinds.Level) -> list[list[int]]:
        length = sum(float(np.linalg.norm(self.nodes[b] - self.nodes[a])) for a, b in itertools.pairwise(axis))
        out, turn = [], self.rng.uniform(0.0, 2.0 * math.pi)
        for k in range(level.count):
            place = level.start + (level.end - level.start) * (k + 0.5) / level.count
            joint, way = self.branch(axis, place, turn, k, level.angle)
            # Branches that start higher are shorter.
            own = level.length * length * self.rng.uniform(0.8, 1.2) * (1.2 - 0.5 * place)
            out.append(self._axis_of(joint, way, own, level.radius * self.radius[joint],
                                     level.taper, level.droop, BRANCH, self.kind.shoot))
        return out

    def _add_leaves(self, bearers: list[list[int]], leaves: kinds.Leaves) -> None:
        """Grow leaves on the axes ``bearers``, as many as the largest number of segments allows."""
        (petiole, radius), (length, width, thickness) = leaves.petiole, leaves.blade
        parts = max(2, min(5, round(length / 0.045)))
        each = parts + (max(1, round(petiole / 0.025)) if petiole > 0.0 else 0)
        sites = [(axis, k) for axis in bearers for k in range(leaves.count)]
        room = max(0, (self.options.max_segments - (len(self.nodes) - 1)) // each)
        wanted = min(room, round(self.options.leaf_share * len(sites)))
        chosen = sorted(self.rng.permutation(len(sites))[:wanted])
        turns = self.rng.uniform(0.0, 2.0 * math.pi, len(bearers) + 1)
        for s in chosen:
            axis, k = sites[s]
            place = leaves.start + (1.0 - leaves.start) * (k + 0.5) / leaves.count
            at, way = self.branch(axis, place, turns[s // leaves.count], k, leaves.angle)
            if petiole > 0.0:
                at = self._axis_of(at, way, petiole, radius, 0.9, 0.0, PETIOLE, self.kind.petiole, step=0.025)[-1]
            modulus = self.drawn(self.kind.leaf)
            own = self._new_axis(LEAF, modulus)
            for start, end, normal, share in self.blade(at, way, length, leaves.droop, parts):
                self.node(start, end, 0.5 * thickness, LEAF, self._varied(modulus), own, 0.5 * width * share, normal)


def _appearance(garden: _Garden, kind: kinds.Species, informative: float, rng: np.random.Generator) -> Appearance:
    """The appearance of every axis: stiffer axes are browner and darker. With probability 1 - ``informative`` an axis
    has the appearance of another, random modulus."""
    spans = {TRUNK: kind.wood, BRANCH: kind.shoot, PETIOLE: kind.petiole, LEAF: kind.leaf}
    albedo, texture, scale, contrast = [], [], [], []
    for region, log_modulus in garden.axes:
        low, high = (math.log(v) for v in spans[region])
        place = min(1.0, max(0.0, (log_modulus - low) / max(high - low, 1e-9)))
        other, keeps, chance = rng.uniform(), rng.uniform() < informative, rng.normal(0.0, 0.08, 3)
        shown = place if keeps else other
        bark, green = np.array(kind.bark), np.array(kind.foliage)
        base = {TRUNK: bark, BRANCH: (0.35 + 0.65 * shown) * bark + (0.65 - 0.65 * shown) * green,
                PETIOLE: 0.6 * green + 0.4 * np.array([0.45, 0.35, 0.12]), LEAF: green}[region]
        albedo.append(np.clip(base * math.exp(-_BRIGHTNESS * (2.0 * shown - 1.0)) * np.exp(chance), 0.01, 0.95))
        texture.append(kind.texture if region in (TRUNK, BRANCH) else ("plain" if region == PETIOLE else "noise"))
        scale.append(rng.uniform(0.004, 0.012))
        contrast.append(rng.uniform(0.1, 0.4) if region != PETIOLE else 0.0)
    return Appearance(np.array(albedo), tuple(texture), np.array(scale), np.array(contrast))
