"""Shapes as a scene file names them: objects to press, and rigid probes to press them with; and signed distances to the
analytic ones in NumPy, for all host code, negative inside.

The kernels' twin of the distances is `vsfsim.physics.contact.sdf`, which also knows meshes. A probe's origin is its
centre; that of a `Plane` is on its surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from vsfsim.core.chain import Chain, read_chain
from vsfsim.core.dome import Dome
from vsfsim.core.errors import MeshError, SceneError, one_of
from vsfsim.core.table import typed, value

LEAST = 1e-5
"""Least length of a shape [m]: under it an elastic continuum is no model of the matter, and a slip of units the
usual cause."""
Length = Annotated[float, msgspec.Meta(ge=LEAST, lt=1e3, description=f"a length in metres, greater than 0 (at least "
                                                                     f"{LEAST:g}, and under 1000)")]
MeshPath = Annotated[str, msgspec.Meta(min_length=1, description=(
    "the path of an OBJ, PLY or STL file, relative to the scene file"))]
Scale = Annotated[float, msgspec.Meta(gt=0.0, lt=1e3, description="a length in metres, greater than 0 (under 1000)")]


@dataclass(frozen=True)
class Box:
    """A block; its local origin is the centre of its base."""

    size: Annotated[tuple[Length, Length, Length], msgspec.Meta(description="[x, y, z], lengths in metres")]
    """Edge lengths (3,) [m]."""


@dataclass(frozen=True)
class Sphere:
    """A ball. As an object its origin is its lowest point; as a probe, its centre."""

    radius: Length
    """Of the ball [m]."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along +z. As an object its origin is the centre of its base; as a probe, its centre."""

    radius: Length
    """Of the section [m]."""
    height: Length
    """Along +z [m]."""


@dataclass(frozen=True)
class Rod:
    """A slender round bar along +x; its origin is the lowest point of its end at x = 0."""

    length: Length
    """Along +x [m]."""
    radius: Length
    """Of the section [m]."""


@dataclass(frozen=True)
class Capsule:
    """A probe: a cylinder along +z with half-spheres on both ends; its origin is its centre."""

    radius: Length
    """Of the section [m]."""
    length: Length
    """Distance between the centres of the half-spheres [m]."""


@dataclass(frozen=True)
class Plane:
    """A probe: the half-space z <= 0 of its own frame is solid, its normal +z points at the object.

    A press moves it like any probe; turn it with the pose. No size.
    """


@dataclass(frozen=True)
class MeshFile:
    """A surface mesh of the user's own (OBJ, PLY, STL). As an object its origin is the centre of its base; as a
    probe, that of its bounding box."""

    path: str
    """The file, relative to the scene file."""
    scale: Scale | None = None
    """Metres per unit of the file [m], or None to decide from the size: a bounding box over 5 units is read as
    millimetres, with a note."""
    up: Literal["x", "y", "z"] = "z"
    """Axis of the file that points up, which becomes z."""

    def content(self) -> bytes:
        """The bytes of the file.

        Raises:
            MeshError: its ending is not of `MESH_FORMATS`, or it cannot be read.
        """
        path = Path(self.path)
        if path.suffix.lower() not in MESH_FORMATS:
            raise MeshError(f"mesh file '{path}' ends in '{path.suffix}'; allowed are {', '.join(MESH_FORMATS)}. "
                            "Convert it, e.g. with MeshLab.")
        try:
            return path.read_bytes()
        except OSError as error:
            raise MeshError(f"mesh file '{path}' cannot be read: {error.strerror}. Give the path of an OBJ, PLY or "
                            "STL file, relative to the scene file.") from error


@dataclass(frozen=True)
class Family:
    """A procedural family in ``scenes/``."""

    name: str
    """Of the family."""
    parameters: Mapping[str, Any]
    """Its own, in SI units."""


ObjectShape = Box | Sphere | Cylinder | Rod | MeshFile | Family
Analytic = Sphere | Capsule | Cylinder | Box | Plane
ProbeShape = Analytic | MeshFile | Chain | Dome

_KINDS: dict[str, Any] = {"box": Box, "sphere": Sphere, "cylinder": Cylinder, "rod": Rod, "capsule": Capsule,
                          "plane": Plane}
"""The shapes that are given by numbers, in the order of their fields."""
MESH_FORMATS = (".obj", ".ply", ".stl")
"""Endings of mesh files that are read."""
OBJECT_SHAPES = ("box", "sphere", "cylinder", "rod", "mesh", "family")
PROBE_SHAPES = ("sphere", "capsule", "cylinder", "box", "plane", "mesh")


def skeleton(shape: Box | Sphere | Cylinder | Capsule) -> tuple[np.ndarray, float]:
    """What a shape surrounds, and how far it reaches beyond: half-sizes (3,) [m] of a box, which of a ball is a point
    and of a capsule a segment, and a radius [m]; a cylinder is that box turned about z."""
    match shape:
        case Box(size):
            return 0.5 * np.array(size), 0.0
        case Sphere(radius):
            return np.zeros(3), radius
        case Capsule(radius, length):
            return np.array([0.0, 0.0, 0.5 * length]), radius
        case Cylinder(radius, height):
            return np.array([radius, radius, 0.5 * height]), 0.0
    raise AssertionError(shape)


def extent(shape: Box | Sphere | Cylinder | Rod) -> np.ndarray:
    """Edge lengths (3,) [m] of an object's bounding box."""
    if isinstance(shape, Rod):
        return np.array([shape.length, 2 * shape.radius, 2 * shape.radius])
    half, radius = skeleton(shape)
    return 2.0 * (half + radius)


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


def parse_probe_shape(table: Any, where: str) -> Analytic | MeshFile:
    """The shape of ``[probe]`` from its TOML table; see `parse_object_shape`."""
    return _shape(table, where, PROBE_SHAPES, "sphere = 0.02")


def _shape(table: Any, where: str, allowed: tuple[str, ...], example: str) -> Any:
    if not isinstance(table, Mapping) or not table:
        raise SceneError(f"{where}: shape is {table!r}; give one of {', '.join(allowed)}, e.g. {{ {example} }}.")
    if "mesh" in table:
        path = value(table["mesh"], MeshPath, f"{where}: mesh")
        return typed(table, MeshFile, f"{where} shape", also=("mesh",), path=path)
    for key in table:
        one_of(key, allowed, f"{where}: the shape", SceneError)
    if len(table) != 1:
        raise SceneError(f"{where}: a shape has one kind, this one has {len(table)}: {', '.join(table)}.")
    ((key, given),) = table.items()
    names = [field.name for field in fields(_KINDS[key])]
    sizes = [given] if len(names) == 1 else given if names else []
    if not isinstance(sizes, (list, tuple)) or len(sizes) != len(names):
        raise SceneError(f"{where}: {key} is {given!r}; give [{', '.join(names)}] in metres.")
    return typed(dict(zip(names, sizes, strict=True)), _KINDS[key], f"{where} {key}")


def parse_probe_shapes(tables: Any, where: str) -> tuple[ProbeShape, ...]:
    """The probes that `probe_tables` wrote: those of a scene, the chain of an [arm] or the dome of a [sensor].

    Raises:
        SceneError: as `parse_probe_shape`.
    """
    readers: dict[str, Callable[[Any, str], ProbeShape]] = {
        "chain": read_chain, "dome": lambda table, where: typed(table, Dome, f"{where} dome")}
    return tuple(readers[key](table[key], where) if (key := next(iter(table), "")) in readers
                 else parse_probe_shape(table, where)
                 for table in (tables if isinstance(tables, list) and tables else [tables]))


def probe_tables(shapes: Sequence[ProbeShape]) -> Any:
    """The table of one probe, or a list of those of several."""
    tables = [probe_table(shape) for shape in shapes]
    return tables if len(tables) > 1 else tables[0]


def probe_table(shape: ProbeShape) -> dict[str, Any]:
    """The TOML/JSON table of a probe; `parse_probe_shape` reads it back."""
    match shape:
        case Chain():
            return {"chain": shape.table()}
        case Dome():
            return {"dome": msgspec.to_builtins(shape)}
        case MeshFile(path, scale, up):
            return {"mesh": path, **({} if scale is None else {"scale": scale}), **({} if up == "z" else {"up": up})}
    sizes = msgspec.to_builtins([getattr(shape, field.name) for field in fields(shape)])
    return {type(shape).__name__.lower(): sizes[0] if len(sizes) == 1 else sizes or True}


def distance(shape: Analytic, points: np.ndarray, *, fillet: float = 0.0) -> np.ndarray:
    """Signed distance (...,) [m] to a shape.

    Args:
        shape: the shape in its own frame.
        points: places (..., 3) [m] in that frame.
        fillet: radius of the rounded edges of a cylinder or a box [m].
    """
    x = np.asarray(points, float)
    if isinstance(shape, Plane):
        return x[..., 2]
    half, radius = skeleton(shape)
    fillet = 0.0 if radius else fillet  # a ball and a capsule have no edges
    q = np.abs(_turned(shape, x)) - half + fillet
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0) - fillet - radius


def _turned(shape: Analytic, vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3), in the plane of x and z if the shape is round about z."""
    if not isinstance(shape, Cylinder):
        return vectors
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([np.hypot(x, y), np.zeros_like(x), z], axis=-1)


def segment_distance(points: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Distance (...,) [m] of ``points`` (..., 3) from the segment between two points (3,) [m]."""
    axis = np.subtract(stop, start)
    t = np.clip((points - start) @ axis / max(float(axis @ axis), 1e-30), 0.0, 1.0)
    return np.linalg.norm(points - start - t[..., None] * axis, axis=-1)


def reach(shape: Analytic | Dome) -> float:
    """Radius of the smallest ball about the origin that holds a shape [m]; infinite for a plane."""
    if isinstance(shape, Plane):
        return float("inf")
    if isinstance(shape, Dome):
        return shape.reach
    half, radius = skeleton(shape)
    return radius + float(np.hypot(half[0], half[2]) if isinstance(shape, Cylinder) else np.linalg.norm(half))


def support(shape: Analytic, direction: np.ndarray) -> float:
    """How far a shape extends from its origin along a unit ``direction`` (3,) of its own frame [m]."""
    if isinstance(shape, Plane):
        return 0.0
    half, radius = skeleton(shape)
    return radius + float((half * np.abs(_turned(shape, np.asarray(direction, float)))).sum())
