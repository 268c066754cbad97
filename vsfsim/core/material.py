"""Young's modulus as a field E(x) over an object, as a scene file gives it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.core import signed_distance
from vsfsim.core.errors import SceneError, did_you_mean, unknown_key
from vsfsim.core.shape import Box, Sphere

_INCLUSIONS = {"sphere": ("x", "y", "z", "radius"), "box": ("x0", "y0", "z0", "x1", "y1", "z1"),
               "capsule": ("x0", "y0", "z0", "x1", "y1", "z1", "radius")}


@dataclass(frozen=True)
class Inclusion:
    """A part of the body with a modulus of its own."""

    kind: str
    """"sphere", "box" or "capsule"."""
    numbers: tuple[float, ...]
    """In the object's frame [m]: sphere centre and radius; box corners; capsule ends and radius."""
    young_modulus: float
    """Inside [Pa]."""

    @property
    def thickness(self) -> float:
        """Least width [m]."""
        if self.kind == "box":
            return float(np.abs(np.subtract(self.numbers[3:], self.numbers[:3])).min())
        return 2.0 * self.numbers[-1]

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (...,) [m] of ``points`` (..., 3) [m], negative inside (box: Chebyshev inside)."""
        n = np.asarray(self.numbers)
        if self.kind == "sphere":
            return signed_distance.distance(Sphere(n[3]), points - n[:3])
        if self.kind == "box":
            low, high = np.minimum(n[:3], n[3:]), np.maximum(n[:3], n[3:])
            return signed_distance.distance(Box(tuple(high - low)), points - 0.5 * (low + high))
        return signed_distance.segment_distance(points, n[:3], n[3:6]) - n[6]


@dataclass(frozen=True)
class MaterialField:
    """Truth of a scene: E(x) [Pa], from a base value, named regions and inclusions (the last one wins)."""

    base: float | None
    """Modulus outside regions and inclusions [Pa], or None if the regions give it."""
    regions: Mapping[str, float]
    """Modulus by region name [Pa]."""
    inclusions: tuple[Inclusion, ...] = ()
    """In order."""

    def evaluate(self, points: np.ndarray, region: np.ndarray | None = None,
                 region_modulus: np.ndarray | None = None) -> np.ndarray:
        """Young's modulus (...,) [Pa] at ``points`` (..., 3) [m] in the object's frame.

        Args:
            points: where.
            region: region index of each point (...,), needed when ``region_modulus`` is given.
            region_modulus: modulus of each region (R,) [Pa]; see `by_region`.
        """
        if region_modulus is not None:
            value = np.asarray(region_modulus, float)[region]
        else:
            assert self.base is not None
            value = np.full(points.shape[:-1], self.base)
        for part in self.inclusions:
            value = np.where(part.distance(points) <= 0.0, part.young_modulus, value)
        return value

    def by_region(self, names: Sequence[str], defaults: np.ndarray | None, where: str) -> np.ndarray:
        """Modulus of each region (R,) [Pa]: the scene's own value, else the base, else the family's.

        Raises:
            SceneError: the scene names a region that the object does not have, or leaves one without a value.
        """
        for name in self.regions:
            if name not in names:
                raise SceneError(f"{where}: young_modulus names region '{name}', which this object does not have. "
                                 f"{did_you_mean(name, names)}")
        out = np.empty(len(names))
        for i, name in enumerate(names):
            if name in self.regions:
                out[i] = self.regions[name]
            elif self.base is not None:
                out[i] = self.base
            elif defaults is not None:
                out[i] = defaults[i]
            else:
                raise SceneError(f"{where}: young_modulus gives no value for region '{name}'; add it under regions, "
                                 f"or give base.")
        return out


def modulus(value: Any, where: str) -> float:
    """A Young's modulus [Pa], refused unless it is a number in 1e0 .. 1e13.

    Raises:
        SceneError: with the value and the range.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 1.0 <= float(value) <= 1e13:
        raise SceneError(f"{where} is {value!r}; a Young's modulus is a positive number of pascals, 1 to 1e13 (rubber "
                         f"is about 1e6).")
    return float(value)


def parse_material(table: Any, where: str) -> MaterialField:
    """The field from ``young_modulus`` of a scene: a number, or base / regions / inclusions.

    Raises:
        SceneError: an unknown key, a modulus that is not positive, or an inclusion of the wrong form.
    """
    if table is None:
        return MaterialField(None, {})
    if not isinstance(table, Mapping):
        return MaterialField(modulus(table, f"{where}: young_modulus"), {})
    for key in table:
        if key not in ("base", "regions", "inclusions"):
            raise SceneError(unknown_key(f"{where} young_modulus", key, ("base", "regions", "inclusions")))
    base = table.get("base")
    regions = table.get("regions", {})
    if not isinstance(regions, Mapping):
        raise SceneError(f"{where}: young_modulus.regions is {regions!r}; give a table of region = pascals.")
    given = table.get("inclusions", [])
    if not isinstance(given, (list, tuple)):
        raise SceneError(f"{where}: young_modulus.inclusions is {given!r}; give a list, e.g. "
                         f"[{{ sphere = [x, y, z, r], value = 1e7 }}].")
    parts = []
    for i, part in enumerate(given):
        spot = f"{where}: young_modulus.inclusions[{i}]"
        if not isinstance(part, Mapping):
            raise SceneError(f"{spot} is {part!r}; give e.g. {{ sphere = [x, y, z, r], value = 1e7 }}.")
        kinds = [k for k in part if k != "value"]
        if len(kinds) != 1 or kinds[0] not in _INCLUSIONS or "value" not in part:
            raise SceneError(f"{spot} has keys {', '.join(part)}; give `value` and one of {', '.join(_INCLUSIONS)}.")
        kind = kinds[0]
        names = _INCLUSIONS[kind]
        numbers = part[kind]
        if not isinstance(numbers, (list, tuple)) or len(numbers) != len(names) or any(
            isinstance(v, bool) or not isinstance(v, (int, float)) or not math.isfinite(v) for v in numbers
        ):
            raise SceneError(f"{spot}: {kind} is {numbers!r}; give [{', '.join(names)}] in metres, finite numbers in "
                             f"the object's frame.")
        if names[-1] == "radius" and numbers[-1] <= 0:
            raise SceneError(f"{spot}: the radius is {numbers[-1]!r}; it must be greater than 0.")
        parts.append(Inclusion(kind, tuple(float(v) for v in numbers), modulus(part["value"], f"{spot}: value")))
    if base is None and not regions and parts:
        raise SceneError(f"{where}: young_modulus has inclusions but no base; give base = pascals.")
    return MaterialField(
        None if base is None else modulus(base, f"{where}: young_modulus.base"),
        {str(k): modulus(v, f"{where}: young_modulus.regions.{k}") for k, v in regions.items()},
        tuple(parts),
    )
