"""What an object is made of, as a scene file gives it: Young's modulus as a field E(x), and foams by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np

from vsfsim.core import shape as shapes
from vsfsim.core.errors import SceneError
from vsfsim.core.table import Finite, Rows, shipped_rows, typed, value

Modulus = Annotated[float, msgspec.Meta(ge=1.0, le=1e13, description=(
    "a Young's modulus, a positive number of pascals, 1 to 1e13 (rubber is about 1e6)"))]
Radius = Annotated[float, msgspec.Meta(gt=0.0, lt=1e300)]


def _numbers(names: str, *types: Any) -> Any:
    return Annotated[tuple[types], msgspec.Meta(  # type: ignore[valid-type]
        description=f"[{names}] in metres, finite numbers in the object's frame, a radius greater than 0")]


_INCLUSIONS = {"sphere": _numbers("x, y, z, radius", *3 * [Finite], Radius),
               "box": _numbers("x0, y0, z0, x1, y1, z1", *6 * [Finite]),
               "capsule": _numbers("x0, y0, z0, x1, y1, z1, radius", *6 * [Finite], Radius)}


@dataclass(frozen=True)
class Inclusion:
    """A part of the body with a modulus of its own."""

    kind: str
    """"sphere", "box" or "capsule"."""
    numbers: tuple[float, ...]
    """In the object's frame [m]: sphere centre and radius; box corners; capsule ends and radius."""
    young_modulus: Modulus
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
            return shapes.distance(shapes.Sphere(n[3]), points - n[:3])
        if self.kind == "box":
            low, high = np.minimum(n[:3], n[3:]), np.maximum(n[:3], n[3:])
            return shapes.distance(shapes.Box(tuple(high - low)), points - 0.5 * (low + high))
        return shapes.segment_distance(points, n[:3], n[3:6]) - n[6]


@dataclass(frozen=True)
class MaterialField:
    """Truth of a scene: E(x) [Pa], from a base value and inclusions (the last one wins)."""

    base: Modulus | None = None
    """Modulus outside the inclusions [Pa], or None for that of each region of a family."""
    inclusions: tuple[Inclusion, ...] = ()
    """In order."""

    def evaluate(self, points: np.ndarray, region: np.ndarray | None = None,
                 region_modulus: np.ndarray | None = None) -> np.ndarray:
        """Young's modulus (...,) [Pa] at ``points`` (..., 3) [m] in the object's frame.

        Args:
            points: where.
            region: region index of each point (...,), needed when ``region_modulus`` is given.
            region_modulus: modulus of each region (R,) [Pa]; see `of_regions`.
        """
        if region_modulus is not None:
            value = np.asarray(region_modulus, float)[region]
        else:
            assert self.base is not None
            value = np.full(points.shape[:-1], self.base)
        for part in self.inclusions:
            value = np.where(part.distance(points) <= 0.0, part.young_modulus, value)
        return value

    def of_regions(self, modulus: np.ndarray | None, where: str) -> np.ndarray | None:
        """Modulus of each region (R,) [Pa] that a family gives, None where the scene's own base counts in all.

        Raises:
            SceneError: neither gives one.
        """
        if self.base is None and modulus is None:
            raise SceneError(f"{where}: young_modulus is missing, and the family gives none; give base = pascals.")
        return None if self.base is not None else modulus


def parse_material(table: Any, where: str) -> MaterialField:
    """The field from ``young_modulus`` of a scene: a number, or base and inclusions.

    Raises:
        SceneError: an unknown key, a modulus that is not positive, or an inclusion of the wrong form.
    """
    if table is None:
        return MaterialField()
    if not isinstance(table, Mapping):
        return MaterialField(value(table, Modulus, f"{where}: young_modulus"))
    place = f"{where} young_modulus"
    parts = tuple(_inclusion(part, f"{place} inclusions[{k}]")
                  for k, part in enumerate(value(table.get("inclusions", []), Rows, f"{place}: inclusions")))
    found = typed(table, MaterialField, place, also=("inclusions",), inclusions=parts)
    if found.base is None and parts:
        raise SceneError(f"{where}: young_modulus has inclusions but no base; give base = pascals.")
    return found


def _inclusion(part: Any, where: str) -> Inclusion:
    kinds = [key for key in part if key != "value"] if isinstance(part, Mapping) else []
    if len(kinds) != 1 or kinds[0] not in _INCLUSIONS or "value" not in part:
        raise SceneError(f"{where} is {part!r}; give `value` and one of {', '.join(_INCLUSIONS)}, e.g. "
                         f"{{ sphere = [x, y, z, r], value = 1e7 }}.")
    return Inclusion(kinds[0], value(part[kinds[0]], _INCLUSIONS[kinds[0]], f"{where}: {kinds[0]}"),
                     value(part["value"], Modulus, f"{where}: value"))


@dataclass(frozen=True)
class Foam:
    """One foam: parameters of the hyperfoam law (Ogden and Storåkers), in the form of Abaqus.

        Psi = sum_i 2 mu_i / alpha_i^2 [ l1^alpha_i + l2^alpha_i + l3^alpha_i - 3 + (J^(-alpha_i beta_i) - 1) / beta_i ]

    beta = nu / (1 - 2 nu) for one term.
    """

    mu: tuple[float, ...]
    """Shear moduli of the terms [Pa]."""
    alpha: tuple[float, ...]
    """Exponents of the principal stretches [-]."""
    beta: tuple[float, ...]
    """Exponents of the volume, over alpha [-]."""

    @property
    def lame(self) -> tuple[float, float]:
        """(mu, lambda) of small strains [Pa]."""
        return sum(self.mu), sum(2.0 * m * b for m, b in zip(self.mu, self.beta, strict=True))

    @property
    def young_modulus(self) -> float:
        """Young's modulus of small strains [Pa]."""
        mu, lam = self.lame
        return mu * (3.0 * lam + 2.0 * mu) / (lam + mu)

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio of small strains [-]."""
        mu, lam = self.lame
        return 0.5 * lam / (lam + mu)


FOAMS: dict[str, Foam] = shipped_rows(__file__, "foams.toml", Foam)
"""Foams that ``material`` in ``[object]`` of a scene may name."""


def parse_law(given: Any, where: str) -> tuple[str, dict[str, tuple[float, ...]]]:
    """The name of the law that ``law`` gives, and its rows of numbers.

    Raises:
        SceneError: it is no name or table of numbers.
    """
    said = value(given, Annotated[str | dict[str, str | Finite | list[Finite]], msgspec.Meta(
        description='a name, or a table of a name and numbers, e.g. law = { name = "hyperfoam", mu = [2e5, 2e4], '
                    'alpha = [8.0, -2.0], beta = [0.0, 0.0] }')], f"{where}: law")
    rows = {"name": said} if isinstance(said, str) else said
    if [key for key, row in rows.items() if isinstance(row, str)] != ["name"]:
        raise SceneError(f"{where}: law is {said!r}; it must have a name, and numbers besides.")
    return rows["name"], {key: tuple(row) if isinstance(row, list) else (row,)
                          for key, row in rows.items() if key != "name"}
