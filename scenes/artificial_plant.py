"""Artificial potted plants: wire-cored stems, branches, petioles and leaves, and a trunk whose pot gives way.

`grow` makes the tree of beams (`vsfsim.core.plant.Plant`). A round part has a core of steel wire in a plastic sheath,
or is solid wood; its bending stiffness is

    E I = pi/64 (E_wire d^4 + E_sheath (D^4 - d^4))        core d, outer diameter D,

and a blade has that of its midrib's wire and of its sheet, E_sheet w t^3 / 12. A beam of the simulator has one modulus:
``young_modulus`` is the effective one, E I over the second moment of the outer section. Wires come in gauges, so the
ratio d / D varies by a few percent from part to part: thickness tells most of the stiffness, as it does on real ones.

Where the budget of segments has no room for all leaves, each leaf that grows stands for several that move together: its
petiole and its blade have their bending stiffness, so the foliage as a whole pushes back as all leaves would.

A wire of diameter d yields at the plastic moment s_y d^3 / 6 of a round section, and the sheath stays elastic. Wood and
the pot's filling do not yield.

Every stem stands in the pot on a joint, a segment of 10 mm whose bending stiffness E I / L is the rotational stiffness
of the pot's filling. Stems and branches, and petioles and blades, have a budget of segments each.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from vsfsim.core.plant import Plant, Pot
from vsfsim.core.solid import Appearance
from vsfsim.core.table import typed
from vsfsim.scenes import _artificial_kinds as kinds
from vsfsim.scenes._artificial_kinds import BRANCH, JOINT, LEAF, PETIOLE, PLANTS, REGIONS, TRUNK, Options
from vsfsim.scenes._growth import Growth

E_STEEL = 2.0e11
"""Young's modulus of steel wire [Pa]."""
E_SHEATH = 2.0e8
"""Of the sheath, low-density polyethylene [Pa]."""
E_SHEET = (2.0e8, 6.0e8)
"""Bounds of Young's modulus of a leaf's sheet, polyethylene, log-uniform for each plant [Pa]."""
E_WOOD = (6.0e9, 1.0e10)
"""Bounds of Young's modulus of a dry natural-wood trunk, log-uniform for each plant [Pa]."""
YIELD_STRESS = 3.0e8
"""At which the wire yields, soft steel of 250 to 400 MPa [Pa]."""
_WIRE_SPREAD = 0.05
"""Standard deviation of ln of the wire's diameter over the outer one, from part to part [-]."""
_DENSITY = 1000.0
"""Of all parts [kg/m^3]; it matters in scenes with gravity only."""
_JOINT_LENGTH, _JOINT_RADIUS = 0.01, 0.01
"""Of the segment that stands for the pot's filling [m]."""
_CLAMPED = 1e11
"""Young's modulus of a segment that gives no way [Pa]."""


def grow(parameters: Mapping[str, Any], rng: np.random.Generator, *, where: str, number: int = 0) -> Plant:
    """A plant in a pot that stands on z = 0, with its foot above the origin.

    Args:
        parameters: fields of `_artificial_kinds.Options`.
        rng: random stream of form, wires and appearance, in this order.
        where: file and section, for error messages.
        number: of the object in its dataset, from 0.

    Raises:
        SceneError: a parameter is unknown or out of its range.
    """
    options = typed(parameters, Options, where)
    name = kinds.name_of(options, int(rng.integers(len(PLANTS))), number)
    kind = _sized(PLANTS[name], options, rng)
    tree = _Tree(kind, options, rng)
    tree.grow()
    region = np.array(tree.region)
    count = [int((region[1:] == r).sum()) for r in range(len(REGIONS))]
    nodes = np.array(tree.nodes)
    return Plant(nodes, np.array(tree.parent), np.array(tree.radius), np.array(tree.half_width),
                 np.array(tree.normal), np.array(tree.modulus), np.full(len(nodes), _DENSITY),
                 region, REGIONS, look=np.array(tree.axis), appearance=_appearance(tree, kind, rng),
                 pot=Pot(kind.pot[0], 0.75 * kind.pot[0], kind.pot[1]), wire=np.array(tree.wire),
                 yielding=np.array(tree.core) if options.yields else None, name=name,
                 notes=(f"{name}: {count[TRUNK] + count[BRANCH]} segments of wood, "
                        f"{count[PETIOLE] + count[LEAF]} of {tree.leaves} leaves (each stands for "
                        f"{tree.each:.1f}), {nodes[:, 2].max():.2f} m high.",))


def _sized(named: kinds.Named, options: Options, rng: np.random.Generator) -> kinds.Kind:
    """The kind of a named plant with its own sizes. The number of draws does not depend on the outcome."""
    kind = kinds.KINDS[named.kind]
    wild = options.plant == "random"
    f = np.exp((math.log(1.3) if wild else math.log1p(options.variation)) * rng.uniform(-1.0, 1.0, 8))
    size, girth = options.size * named.size * f[0], options.girth * named.girth * f[1]

    def scaled(stalk: kinds.Stalk, by: float) -> kinds.Stalk:
        return replace(stalk, length=size * by * stalk.length, diameter=girth * stalk.diameter)

    levels = tuple(replace(level, count=max(1, round(level.count * named.dense * f[2])),
                           angle=level.angle * f[3] ** 0.5, stalk=scaled(level.stalk, f[4])) for level in kind.levels)
    length, width, thick = kind.leaves.blade
    petiole = kind.leaves.petiole
    blade = named.leaf * f[5]
    leaves = replace(
        kind.leaves, count=max(1, round(options.leaves * kind.leaves.count * named.dense * f[6])),
        petiole=None if petiole is None else replace(petiole, length=blade * petiole.length,
                                                     diameter=girth * petiole.diameter),
        blade=(blade * length, blade * width, thick), midrib=girth * kind.leaves.midrib)
    return replace(kind, stem=scaled(kind.stem, f[7]), levels=levels, leaves=leaves)


class _Tree(Growth):
    """The plant while it grows; of each axis its region."""

    def __init__(self, kind: kinds.Kind, options: Options, rng: np.random.Generator):
        super().__init__(rng, np.array([0.0, 0.0, kind.pot[1] - _JOINT_LENGTH]), 0.01)
        self.kind, self.options, self.axes = kind, options, [JOINT]
        self.wood, self.sheet = self.drawn(E_WOOD), self.drawn(E_SHEET)
        self.wire = [0.0]
        self.core = [(0.0, 0.0)]  # E I of the wires of each segment, and the moment at which they yield
        self.leaves, self.each = 0, 1.0
        self.step_length = self._step()

    def _step(self) -> float:
        """Length of the segments of wood [m]: the options' own, or longer so that all branches fit the budget."""
        lengths, bearers = [self.kind.stem.length] * self.kind.stems, self.kind.stems
        for level in self.kind.levels:
            bearers *= level.count
            lengths += [level.stalk.length] * bearers
        step = self.options.segment
        while sum(max(1, round(1.1 * length / step)) for length in lengths) > self.options.wood_segments:
            if step > 2.0 * max(lengths):
                break  # one segment an axis is the least
            step *= 1.1
        return step

    def grow(self) -> None:
        kind, bearers = self.kind, []
        for way, place in self.stems(kind.stems, kind.spread, kind.lean, 0.001):
            root = 0
            if place is not None:  # a stiff segment in the filling leads to the foot of the stem
                root = self._part(0, place, 0.01, JOINT, _CLAMPED, 0)
            second = math.pi * _JOINT_RADIUS**4 / 4.0
            filling = self.drawn(kind.joint) * _JOINT_LENGTH / second
            foot = self._part(root, self.nodes[root] + _JOINT_LENGTH * way, _JOINT_RADIUS, JOINT,
                              _CLAMPED if self.options.fixed else filling, 0)
            bearers.append(self._stalk(foot, way, kind.stem, TRUNK, self.step_length))
        for level in kind.levels:
            bearers = [child for axis in bearers for child in self._branches(axis, level)]
        self._add_leaves(bearers, kind.leaves)

    def _part(self, *segment: Any, wire: float = 0.0, core: tuple[float, float] = (0.0, 0.0), **more: Any) -> int:
        """Add a segment with its wire."""
        self.wire.append(wire)
        self.core.append(core)
        return self.node(*segment, **more)

    def _new_axis(self, region: int) -> int:
        self.axes.append(region)
        return len(self.axes) - 1

    def _stalk(self, start: int, way: np.ndarray, stalk: kinds.Stalk, region: int, step: float,
               factor: float = 1.0) -> list[int]:
        """Grow a round part of ``factor`` times its length from node ``start``; its nodes, the start first."""
        length = factor * stalk.length
        count = max(1, round(length / step))
        wire = stalk.wire * stalk.diameter * math.exp(_WIRE_SPREAD * self.rng.normal())
        axis, out, at = self._new_axis(region), [start], start
        several = self.each if region == PETIOLE else 1.0
        for k in range(count):
            way, place = self.step(at, way, length, count, stalk.droop)
            if place[2] < 0.03:  # nothing grows into the table
                break
            outer = stalk.diameter * (1.0 - (1.0 - stalk.taper) * (k + 0.5) / count)
            at = self._part(at, place, 0.5 * outer, region, several
                            * round_modulus(outer, wire, self.wood), axis, wire=wire if region
                            != PETIOLE else 0.0, core=wire_core(min(wire, outer), several))
            out.append(at)
        return out

    def _branches(self, axis: list[int], level: kinds.Level) -> list[list[int]]:
        out, turn = [], self.rng.uniform(0.0, 2.0 * math.pi)
        for k in range(level.count):
            place = level.start + (1.0 - level.start) * (k + 0.5) / level.count
            joint, way = self.branch(axis, place, turn, k, level.angle)
            # Branches that start higher are shorter.
            out.append(self._stalk(joint, way, level.stalk, BRANCH, self.step_length,
                                   self.rng.uniform(0.85, 1.15) * (1.2 - 0.35 * place)))
        return [branch for branch in out if len(branch) > 1]

    def _add_leaves(self, bearers: list[list[int]], leaves: kinds.Leaves) -> None:
        """Grow leaves on the axes ``bearers``, as many as the budget allows."""
        length, width, thickness = leaves.blade
        parts = max(2, min(4, round(length / 0.06)))
        each = parts + (leaves.petiole is not None)
        sites = list(itertools.product(range(len(bearers)), range(leaves.count)))
        room = min(len(sites), self.options.leaf_segments // each)
        self.each = len(sites) / max(room, 1)
        turns = self.rng.uniform(0.0, 2.0 * math.pi, len(bearers) + 1)
        for s in sorted(self.rng.permutation(len(sites))[:room]):
            bearer, k = sites[s]
            place = leaves.start + (1.0 - leaves.start) * (k + 0.5) / leaves.count
            at, way = self.branch(bearers[bearer], place, turns[bearer], k, leaves.angle)
            if leaves.petiole is not None:
                at = self._stalk(at, way, leaves.petiole, PETIOLE, leaves.petiole.length)[-1]
            wire = leaves.midrib * math.exp(_WIRE_SPREAD * self.rng.normal())
            axis = self._new_axis(LEAF)
            for start, end, normal, share in self.blade(at, way, length, leaves.droop, parts):
                modulus = self.each * blade_modulus(width * share, thickness, wire, self.sheet)
                self._part(start, end, 0.5 * thickness, LEAF, modulus, axis, 0.5 * (width * share),
                           normal, core=wire_core(wire, self.each))
            self.leaves += 1


def round_modulus(outer: float, wire: float, wood: float) -> float:
    """Effective Young's modulus in bending [Pa] of a round section of diameter ``outer`` [m]: steel wire of diameter
    ``wire`` [m] in a sheath, or solid wood of the modulus ``wood`` [Pa] where there is no wire."""
    if wire == 0.0:
        return wood
    share = (min(wire, outer) / outer) ** 4
    return E_STEEL * share + E_SHEATH * (1.0 - share)


def wire_core(diameter: float, count: float) -> tuple[float, float]:
    """Bending stiffness [N m^2] of ``count`` steel wires of a ``diameter`` [m] that bend side by side, and the moment
    at which they yield, their plastic moment [N m]; zeros where there is no wire."""
    return count * E_STEEL * math.pi * diameter**4 / 64.0, count * YIELD_STRESS * diameter**3 / 6.0


def blade_modulus(width: float, thickness: float, wire: float, sheet: float) -> float:
    """Effective Young's modulus in bending [Pa] of a blade of ``width`` and ``thickness`` [m]: a sheet of the modulus
    ``sheet`` [Pa] and a midrib of steel wire of diameter ``wire`` [m]."""
    return sheet + E_STEEL * math.pi * wire**4 / 64.0 / (width * thickness**3 / 12.0)


def _appearance(tree: _Tree, kind: kinds.Kind, rng: np.random.Generator) -> Appearance:
    """The appearance of every axis: the colour of its part, with a small random tint. The colour of a part says
    nothing about its own wire."""
    bark, green = np.array(kind.bark), np.array(kind.foliage)
    base = {JOINT: bark, TRUNK: bark, BRANCH: 0.75 * bark + 0.25 * green,
            PETIOLE: 0.6 * green + 0.4 * np.array([0.45, 0.35, 0.12]), LEAF: green}
    albedo, texture, scale, contrast = [], [], [], []
    for region in tree.axes:
        albedo.append(np.clip(base[region] * np.exp(rng.normal(0.0, 0.15) + rng.normal(0.0, 0.06, 3)), 0.01, 0.95))
        wooden = region in (JOINT, TRUNK, BRANCH)
        texture.append(kind.texture if wooden else ("plain" if region == PETIOLE else "noise"))
        scale.append(rng.uniform(0.004, 0.012))
        contrast.append(rng.uniform(0.1, 0.4) if region != PETIOLE else 0.0)
    return Appearance(np.array(albedo), tuple(texture), np.array(scale), np.array(contrast))
