"""Shapes as a scene file names them: objects to press, and rigid probes to press them with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vsfsim.core.chain import Chain, read_chain
from vsfsim.core.dome import Dome, read_dome
from vsfsim.core.errors import SceneError, did_you_mean, unknown_key


@dataclass(frozen=True)
class Box:
    """A block; its local origin is the centre of its base."""

    size: tuple[float, float, float]
    """Edge lengths (3,) [m]."""


@dataclass(frozen=True)
class Sphere:
    """A ball. As an object its origin is its lowest point; as a probe, its centre."""

    radius: float
    """Of the ball [m]."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along +z. As an object its origin is the centre of its base; as a probe, its centre."""

    radius: float
    """Of the section [m]."""
    height: float
    """Along +z [m]."""


@dataclass(frozen=True)
class Rod:
    """A slender round bar along +x; its origin is the lowest point of its end at x = 0."""

    length: float
    """Along +x [m]."""
    radius: float
    """Of the section [m]."""


@dataclass(frozen=True)
class Capsule:
    """A probe: a cylinder along +z with half-spheres on both ends; its origin is its centre."""

    radius: float
    """Of the section [m]."""
    length: float
    """Distance between the centres of the half-spheres [m]."""


@dataclass(frozen=True)
class Plane:
    """A probe: the half-space z <= 0 of its own frame is solid, its normal +z points at the object.

    A press moves it like any probe; turn it with the pose. No size.
    """


@dataclass(frozen=True)
class MeshFile:
    """A surface mesh of the user's own (OBJ, PLY, STL, OFF). As an object its origin is the centre of its base; as a
    probe, that of its bounding box."""

    path: str
    """The file, relative to the scene file."""
    scale: float | None = None
    """Metres per unit of the file [m], or None to decide from the size: a bounding box over 5 units is read as
    millimetres, with a note."""
    up: str = "z"
    """Axis of the file that points up, one of `UP`; it becomes z."""


@dataclass(frozen=True)
class Family:
    """A procedural family in ``scenes/``."""

    name: str
    """Of the family."""
    parameters: Mapping[str, Any]
    """Its own, in SI units."""


ObjectShape = Box | Sphere | Cylinder | Rod | MeshFile | Family
ProbeShape = Sphere | Capsule | Cylinder | Plane | Box | MeshFile | Chain | Dome

UP = ("x", "y", "z")
"""Axes of a mesh file that may point up."""
_SIZES: dict[str, tuple[Any, tuple[str, ...]]] = {
    "box": (lambda *size: Box(size), ("x", "y", "z")), "sphere": (Sphere, ("radius",)),
    "cylinder": (Cylinder, ("radius", "height")), "rod": (Rod, ("length", "radius")),
    "capsule": (Capsule, ("radius", "length"))}
"""What a shape of this name is made by, and of which lengths."""
OBJECT_SHAPES = ("box", "sphere", "cylinder", "rod", "mesh", "family")
PROBE_SHAPES = ("sphere", "capsule", "cylinder", "box", "plane", "mesh")


def extent(shape: Box | Sphere | Cylinder | Rod) -> tuple[float, float, float]:
    """Edge lengths of an object's bounding box (3,) [m]."""
    match shape:
        case Box(size):
            return size
        case Sphere(radius):
            return (2 * radius,) * 3
        case Cylinder(radius, height):
            return (2 * radius, 2 * radius, height)
        case Rod(length, radius):
            return (length, 2 * radius, 2 * radius)
    raise AssertionError(shape)


LEAST = 1e-5
"""Least length of a shape [m]: under it an elastic continuum is no model of the matter, and a slip of units the
usual cause."""


def _length(where: str, name: str, value: Any, least: float = LEAST) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < float(value) < 1e3:
        raise SceneError(f"{where}: {name} is {value!r}; it must be a length in metres, greater than 0 (and under "
                         f"1000).")
    if value < least:
        raise SceneError(f"{where}: {name} is {value!r}; it must be a length in metres, at least {least:g}.")
    return float(value)


def parse_object_shape(table: Any, where: str) -> ObjectShape:
    """The shape of ``[object]`` from its TOML table.

    Args:
        table: e.g. ``{"box": [0.1, 0.1, 0.05]}`` or ``{"family": "shoe", "length": 0.26}``.
        where: file and section, for the messages.

    Raises:
        SceneError: not a table, an unknown shape, or sizes that are not positive lengths.
    """
    if isinstance(table, Mapping) and "family" in table:
        return Family(str(table["family"]), {k: v for k, v in table.items() if k != "family"})
    return _shape(table, where, OBJECT_SHAPES, "box = [0.1, 0.1, 0.05]")


def parse_probe_shape(table: Any, where: str) -> ProbeShape:
    """The shape of ``[probe]`` from its TOML table; see `parse_object_shape`."""
    for name, read in (("chain", read_chain), ("dome", read_dome)):  # of a dataset's file; a scene says [arm], [sensor]
        if isinstance(table, Mapping) and name in table:
            return read(table[name], where)
    return _shape(table, where, PROBE_SHAPES, "sphere = 0.02")


def _shape(table: Any, where: str, allowed: tuple[str, ...], example: str) -> Any:
    if not isinstance(table, Mapping) or not table:
        raise SceneError(f"{where}: shape is {table!r}; give one of {', '.join(allowed)}, e.g. {{ {example} }}.")
    if "mesh" in table:
        return _mesh(table, where)
    for key in table:
        if key not in allowed:
            raise SceneError(f"{where}: unknown shape '{key}'. {did_you_mean(key, allowed)}")
    if len(table) != 1:
        raise SceneError(f"{where}: a shape has one kind, this one has {len(table)}: {', '.join(table)}.")
    ((key, value),) = table.items()
    if key == "plane":
        return Plane()
    make, names = _SIZES[key]
    given = [value] if len(names) == 1 else value
    if not isinstance(given, (list, tuple)) or len(given) != len(names):
        raise SceneError(f"{where}: {key} is {value!r}; give [{', '.join(names)}] in metres.")
    return make(*(_length(where, f"{key} {name}", v) for name, v in zip(names, given, strict=True)))


def _mesh(table: Mapping[str, Any], where: str) -> MeshFile:
    for key in table:
        if key not in ("mesh", "scale", "up"):
            raise SceneError(unknown_key(f"{where} shape", key, ("mesh", "scale", "up")))
    if not isinstance(table["mesh"], str) or not table["mesh"]:
        raise SceneError(f"{where}: mesh is {table['mesh']!r}; give the path of an OBJ, PLY, STL or OFF file, relative "
                         f"to the scene file.")
    scale, up = table.get("scale"), table.get("up", "z")
    if up not in UP:
        raise SceneError(f"{where}: up is {up!r}; it is the axis of the mesh file that points up, one of "
                         f"{', '.join(UP)}.")
    return MeshFile(table["mesh"], None if scale is None else _length(where, "scale", scale, 0.0), up)


def parse_probe_shapes(tables: Any, where: str) -> tuple[ProbeShape, ...]:
    """The probes that `probe_tables` wrote; raises as `parse_probe_shape`."""
    given = tables if isinstance(tables, list) and tables else [tables]
    return tuple(parse_probe_shape(table, where) for table in given)


def probe_tables(shapes: Sequence[ProbeShape]) -> Any:
    """The table of one probe, or a list of those of several."""
    tables = [probe_table(shape) for shape in shapes]
    return tables if len(tables) > 1 else tables[0]


def probe_table(shape: ProbeShape) -> dict[str, Any]:
    """The TOML/JSON table of a probe; `parse_probe_shape` reads it back."""
    match shape:
        case Plane():
            return {"plane": True}
        case Chain():
            return {"chain": shape.table()}
        case Dome():
            return {"dome": shape.table()}
        case MeshFile(path, scale, up):
            return {"mesh": path, **({} if scale is None else {"scale": scale}), **({} if up == "z" else {"up": up})}
    name = type(shape).__name__.lower()
    sizes = [*shape.size] if isinstance(shape, Box) else [getattr(shape, key) for key in _SIZES[name][1]]
    return {name: sizes if len(sizes) > 1 else sizes[0]}
