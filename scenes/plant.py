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
from vsfsim.scenes._plant_species import (
    BRANCH,
    LEAF,
    PETIOLE,
    REGIONS,
    TRUNK,
    Leaves,
    Level,
    PlantOptions,
    Species,
    drawn,
    read_parameters,
)

_GOLDEN = 2.399963
"""The golden angle [rad]."""
_DIRECTION_SPREAD = 0.05
"""Standard deviation of the random change of an axis's direction per segment [rad]."""
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
    options = read_parameters(parameters, where)
    name, kind = drawn(options, rng, number)
    garden = _Garden(kind, options, rng)
    garden.grow()
    n = len(garden.nodes)
    look = _appearance(garden, kind, options.appearance_informative, rng)
    region = np.array(garden.region)
    return Plant(
        np.array(garden.nodes), np.array(garden.parent), np.array(garden.radius), np.array(garden.half_width),
        np.array(garden.normal), np.array(garden.modulus) * options.modulus_factor,
        np.where(region == LEAF, _LEAF_DENSITY, _WOOD_DENSITY), region, REGIONS,
        look=np.array(garden.axis), appearance=look, pot=Pot(kind.pot[0], 0.75 * kind.pot[0], kind.pot[1]),
        notes=(f"{name}: {n - 1} segments, {sum(r == LEAF for r in garden.region[1:])} of them of leaves, "
               f"{garden.nodes_top():.2f} m high.",))


class _Garden:
    """The plant while it grows: lists with one entry per node, and lists with one entry per axis."""

    def __init__(self, kind: Species, options: PlantOptions, rng: np.random.Generator):
        self.kind, self.options, self.rng = kind, options, rng
        foot = np.array([0.0, 0.0, kind.pot[1]])
        self.nodes, self.parent, self.radius, self.half_width = [foot], [-1], [kind.radius], [0.0]
        self.normal, self.modulus, self.region, self.axis = [np.zeros(3)], [1e9], [TRUNK], [0]
        self.axes: list[tuple[int, float]] = []  # region and ln of the mean modulus
        self.shoots: list[list[int]] = []  # nodes of the axes that bear leaves

    def nodes_top(self) -> float:
        return max(p[2] for p in self.nodes)

    def grow(self) -> None:
        kind = self.kind
        stems = []
        for k in range(kind.stems):
            azimuth = k * _GOLDEN + self.rng.uniform(-0.3, 0.3)
            out = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
            lean = kind.lean * self.rng.uniform(0.5, 1.0)
            way = math.cos(lean) * np.array([0.0, 0.0, 1.0]) + math.sin(lean) * out
            root = 0
            if kind.spread > 0.0:  # a stiff segment in the soil joins every stem to the clamped node
                place = (self.nodes[0] + kind.spread * math.sqrt((k + 0.5) / kind.stems) * out
                         + [0.0, 0.0, 0.002])
                root = self._node(0, place, max(kind.radius, 0.01), TRUNK, 1e10, self._new_axis(TRUNK, 1e10))
            stems.append(self._axis_of(root, way, kind.height * self.rng.uniform(0.85, 1.1), kind.radius, kind.taper,
                                       kind.droop, TRUNK, kind.wood))
        bearers = stems
        for level in kind.levels:
            bearers = [child for axis in bearers for child in self._branches(axis, level)]
        if self.options.leaves:
            self._add_leaves(bearers, kind.leaves)

    def _new_axis(self, region: int, modulus: float) -> int:
        self.axes.append((region, math.log(modulus)))
        return len(self.axes) - 1

    def _node(self, parent: int, place: np.ndarray, radius: float, region: int, modulus: float, axis: int,
              half_width: float = 0.0, normal: np.ndarray | None = None) -> int:
        self.nodes.append(place)
        self.parent.append(parent)
        self.radius.append(radius)
        self.half_width.append(half_width)
        self.normal.append(np.zeros(3) if normal is None else normal)
        self.region.append(region)
        self.modulus.append(modulus)
        self.axis.append(axis)
        return len(self.nodes) - 1

    def _draw(self, span: tuple[float, float]) -> float:
        return math.exp(self.rng.uniform(math.log(span[0]), math.log(span[1])))

    def _axis_of(self, start: int, way: np.ndarray, length: float, radius: float, taper: float, droop: float,
                 region: int, span: tuple[float, float], *, step: float | None = None) -> list[int]:
        """Grow a chain of round segments from node ``start``; its nodes, the start first."""
        count = max(1, round(length / (step or self.options.segment)))
        modulus = self._draw(span)
        axis = self._new_axis(region, modulus)
        out, at = [start], start
        for k in range(count):
            way = way + self.rng.normal(0.0, _DIRECTION_SPREAD, 3) - [0.0, 0.0, droop * length / count]
            way = way / np.linalg.norm(way)
            place = self.nodes[at] + length / count * way
            if place[2] < 0.02:  # nothing grows into the table
                place = np.array([place[0], place[1], 0.02])
                if np.linalg.norm(place - self.nodes[at]) < 0.2 * length / count:
                    break
            thick = radius * (1.0 - (1.0 - taper) * (k + 0.5) / count)
            at = self._node(at, place, thick, region, modulus * math.exp(_MODULUS_SPREAD * self.rng.normal()), axis)
            out.append(at)
        return out

    def _branches(self, axis: list[int], level: Level) -> list[list[int]]:
        length = sum(float(np.linalg.norm(self.nodes[b] - self.nodes[a])) for a, b in itertools.pairwise(axis))
        out, turn = [], self.rng.uniform(0.0, 2.0 * math.pi)
        for k in range(level.count):
            place = level.start + (level.end - level.start) * (k + 0.5) / level.count
            joint = axis[max(1, min(len(axis) - 1, round(place * (len(axis) - 1))))]
            way = self._around(joint, turn + k * _GOLDEN, level.angle * self.rng.uniform(0.8, 1.2))
            # Branches that start higher are shorter.
            out.append(self._axis_of(joint, way,
                                     level.length * length * self.rng.uniform(0.8, 1.2) * (1.2 - 0.5 * place),
                                     level.radius * self.radius[joint], level.taper, level.droop, BRANCH,
                                     self.kind.shoot))
        return out

    def _around(self, node: int, azimuth: float, angle: float) -> np.ndarray:
        along = self.nodes[node] - self.nodes[self.parent[node]]
        along = along / np.linalg.norm(along)
        side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        side /= np.linalg.norm(side)
        across = math.cos(azimuth) * side + math.sin(azimuth) * np.cross(along, side)
        return math.cos(angle) * along + math.sin(angle) * across

    def _add_leaves(self, bearers: list[list[int]], leaves: Leaves) -> None:
        """Grow leaves on the axes ``bearers``, as many as the largest number of segments allows."""
        blade_parts = max(2, min(5, round(leaves.blade[0] / 0.045)))
        each = blade_parts + (max(1, round(leaves.petiole[0] / 0.025)) if leaves.petiole[0] > 0.0 else 0)
        sites = [(axis, k) for axis in bearers for k in range(leaves.count)]
        room = max(0, (self.options.max_segments - (len(self.nodes) - 1)) // each)
        wanted = min(room, round(self.options.leaf_share * len(sites)))
        chosen = sorted(self.rng.permutation(len(sites))[:wanted])
        turns = self.rng.uniform(0.0, 2.0 * math.pi, len(bearers) + 1)
        for s in chosen:
            axis, k = sites[s]
            place = leaves.start + (1.0 - leaves.start) * (k + 0.5) / leaves.count
            joint = axis[max(1, min(len(axis) - 1, round(place * (len(axis) - 1))))]
            way = self._around(joint, turns[s // leaves.count] + k * _GOLDEN, leaves.angle * self.rng.uniform(0.8, 1.2))
            at = joint
            if leaves.petiole[0] > 0.0:
                at = self._axis_of(joint, way, leaves.petiole[0], leaves.petiole[1], 0.9, 0.0, PETIOLE,
                                   self.kind.petiole, step=0.025)[-1]
            self._blade(at, way, leaves, blade_parts)

    def _blade(self, at: int, way: np.ndarray, leaves: Leaves, parts: int) -> None:
        length, width, thickness = leaves.blade
        modulus = self._draw(self.kind.leaf)
        axis = self._new_axis(LEAF, modulus)
        for k in range(parts):
            way = way - np.array([0.0, 0.0, leaves.droop * length / parts])
            way = way / np.linalg.norm(way)
            place = self.nodes[at] + length / parts * way
            if place[2] < 0.02:
                return
            normal = np.array([0.0, 0.0, 1.0]) - way[2] * way
            if np.linalg.norm(normal) < 0.1:  # the normal of an upright blade is arbitrary
                normal = np.cross(way, np.array([1.0, 0.0, 0.0]))
            normal /= np.linalg.norm(normal)
            shape = math.sin(math.pi * (0.12 + 0.76 * (k + 0.5) / parts))
            local = modulus * math.exp(_MODULUS_SPREAD * self.rng.normal())
            at = self._node(at, place, 0.5 * thickness, LEAF, local, axis, 0.5 * width * shape, normal)


def _appearance(garden: _Garden, kind: Species, informative: float, rng: np.random.Generator) -> Appearance:
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
