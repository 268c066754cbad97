"""``[object]``: what is touched, where it stands, and what it is made of."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, did_you_mean
from vsfsim.core.material import MaterialField, parse_material
from vsfsim.core.rigid import MAX_FRICTION, beside
from vsfsim.core.scene_tables.foam import FOAMS, Foam
from vsfsim.core.shape import Family, ObjectShape, parse_object_shape
from vsfsim.core.table import Table, number, read, vector, word

TIERS = ("auto", "vsf", "linear", "fem-coarse", "fem", "fem-fine", "rod")
"""Fidelities that a scene may name."""


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """``[object]``."""

    shape: ObjectShape
    """Of the object."""
    pose: tuple[float, float, float] = vector((0.0, 0.0, 0.0))
    """Base centre in the world (3,) [m]."""
    yaw: float = number(0.0, -2 * math.pi, 2 * math.pi, "rad")
    """Rotation about +z [rad]."""
    fixed: str | tuple[float, ...]
    """Either "bottom", "none", or a box (x0, y0, z0, x1, y1, z1) [m] in the object's frame whose nodes are held."""
    tier: str = word(*TIERS)
    """Fidelity, one of `TIERS`."""
    resolution: float | None = number(None, 1e-5, 1.0, "m")
    """Element size [m], or None for the tier's own."""
    poisson_ratio: float = number(0.45, 0.0, 0.4999)
    """Of the whole object [-]."""
    density: float = number(1000.0, 1e-3, 3e4, "kg/m^3")
    """Of the whole object [kg/m^3]."""
    friction: float = number(0.0, 0.0, MAX_FRICTION)
    """Coulomb coefficient against rigid bodies [-]."""
    young_modulus: MaterialField
    """The field E(x) [Pa]."""
    foam: Foam | None
    """The foam that `material` names, whose moduli are scaled to `young_modulus`; None for another law."""
    law: tuple[str, Mapping[str, tuple[float, ...]]] | None
    """Name and rows of numbers of the law that ``law`` gives, see `vsfsim.physics.laws.law`; None for the neo-Hookean
    one."""
    appearance: Mapping[str, Any]
    """Table for the family or the renderer."""


def parse_object(node: Any, path: Path) -> ObjectSpec:
    """The table ``[object]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    where = f"{path} [object]"
    own = ("shape", "fixed", "young_modulus", "material", "law", "appearance")
    t = Table(node, where, (*(f.name for f in dataclasses.fields(ObjectSpec)), *own))
    shape = beside(parse_object_shape(t.table.get("shape"), where), path)  # type: ignore[arg-type]
    fixed = t.table.get("fixed", "bottom")
    fixed = t.word("fixed", "bottom", ("bottom", "none")) if isinstance(fixed, str) else t.vector("fixed", None, 6)
    material, family = parse_material(t.table.get("young_modulus"), where), isinstance(shape, Family)
    foam = _foam(t, family)
    if foam is not None and "young_modulus" not in t.table:
        material = MaterialField(foam.young_modulus, {})
    if material.base is None and not family:
        raise SceneError(f"{where}: young_modulus is missing; give pascals, e.g. young_modulus = 1e5, or "
                         f"{{ base = 1e5, inclusions = [..] }}.")
    appearance = t.table.get("appearance", {})
    if not isinstance(appearance, Mapping):
        raise SceneError(f"{where}: appearance is {appearance!r}; it must be a table.")
    found = read(ObjectSpec, node, where, own, shape=shape, fixed=fixed, young_modulus=material, foam=foam,
                 law=_law(t, family), appearance=appearance)
    return found if foam is None else dataclasses.replace(found, poisson_ratio=foam.poisson_ratio)


def _foam(t: Table, family: bool) -> Foam | None:
    """The foam that ``material`` names.

    Raises:
        SceneError: there is no such foam, it has a Poisson's ratio of its own, or the object is of several materials.
    """
    if "material" not in t.table:
        return None
    name = t.table["material"]
    if not isinstance(name, str) or name not in FOAMS:
        raise SceneError(f"{t.where}: material is {name!r}, which is no foam with known parameters. "
                         f"{did_you_mean(str(name), tuple(FOAMS))} Without material the law is neo-Hookean, with "
                         f"young_modulus and poisson_ratio.")
    if "poisson_ratio" in t.table:
        raise SceneError(f"{t.where}: material = {name!r} has a Poisson's ratio of its own, "
                         f"{FOAMS[name].poisson_ratio:.3g}; leave poisson_ratio = {t.table['poisson_ratio']!r} out.")
    if family:
        raise SceneError(f"{t.where}: material = {name!r} is for objects of one material; a family's parts have "
                         f"materials of their own. Leave it out, or give a box, a cylinder, a sphere or a mesh.")
    return FOAMS[name]


def _law(t: Table, family: bool) -> tuple[str, dict[str, tuple[float, ...]]] | None:
    """The law that ``law`` names, with its rows of numbers.

    Raises:
        SceneError: it is no name or table of numbers, or the object has its laws from elsewhere.
    """
    if "law" not in t.table:
        return None
    given = t.table["law"]
    table = {"name": given} if isinstance(given, str) else given
    rows = {}
    for key, value in table.items() if isinstance(table, Mapping) else ():
        numbers = value if isinstance(value, list) else [value]
        if key != "name" and all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v)
                                 for v in numbers):
            rows[key] = tuple(float(v) for v in numbers)
    if not isinstance(table, Mapping) or not isinstance(table.get("name"), str) or len(rows) != len(table) - 1:
        raise SceneError(f"{t.where}: law is {given!r}; it must be a name, or a table of a name and numbers, e.g. "
                         f'law = {{ name = "hyperfoam", mu = [2e5, 2e4], alpha = [8.0, -2.0], beta = [0.0, 0.0] }}.')
    if family or "material" in t.table:
        raise SceneError(f"{t.where}: law = {given!r} beside "
                         f"{'a family, whose parts have laws' if family else 'material, which has a law'} of its own. "
                         f"Leave one of them out.")
    return table["name"], rows
