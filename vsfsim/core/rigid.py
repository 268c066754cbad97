"""The rigid side of a scene: the probe, what moves with it, what stands in the world, and the path of a press."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError
from vsfsim.core.shape import MeshFile, ProbeShape, Sphere, parse_probe_shape
from vsfsim.core.table import Table, integer, numbers, read, whole

Vector = tuple[float, float, float]
ORIGIN: Vector = (0.0, 0.0, 0.0)
MAX_BODIES = 64  # probe, parts and obstacles together; every contact point is compared with each of them
MAX_FRICTION = 10.0


@dataclass(frozen=True)
class RigidBody:
    """A rigid body at a fixed place: an ``[[obstacles]]`` in the world, or a ``[[probe.parts]]`` in the probe's
    frame."""

    shape: ProbeShape
    """Of the body."""
    position: Vector
    """Of its origin (3,) [m]."""
    rotation: Vector
    """Rotation vector (3,) [rad]."""
    friction: float | None
    """Coulomb coefficient against the object [-], or None for that of the object."""


@dataclass(frozen=True)
class PressSpec:
    """``[press]``: the path of the probe's origin, and its rotation."""

    path: tuple[Vector, ...]
    """Corner points (k >= 2, 3) [m], world; straight in between."""
    frames: tuple[int, ...]
    """Equilibria on each of the k - 1 parts, the last of them at its end; the first point itself is no frame."""
    hold: int = integer(0, 0, 10_000)
    """Frames that stay at the last point."""
    retract: int = integer(0, 0, 10_000)
    """Frames on the way back along the path."""
    rotation: tuple[Vector, ...] | None = None
    """Rotation vectors (k, 3) [rad] of the probe in the world at the corner points, between two of them the shortest
    rotation at constant speed. None: the probe points along the first part of the path and keeps that direction."""

    @property
    def start(self) -> Vector:
        """First point of the path (3,) [m]."""
        return self.path[0]

    @property
    def stop(self) -> Vector:
        """Last point of the path (3,) [m]."""
        return self.path[-1]

    @property
    def inward(self) -> int:
        """Number of frames before hold and retract."""
        return sum(self.frames)


def beside(shape: ProbeShape, path: Path) -> ProbeShape:
    """A mesh's file relative to the scene file ``path``; other shapes as they are."""
    if isinstance(shape, MeshFile) and not Path(shape.path).is_absolute():
        return MeshFile(str(path.parent / shape.path), shape.scale, shape.up)
    return shape


def parse_probe(node: Any, path: Path) -> tuple[ProbeShape, tuple[RigidBody, ...]]:
    """Shape and parts of ``[probe]``; a ball of 20 mm radius where there is no such table."""
    where = f"{path} [probe]"
    if node is None:
        return Sphere(0.02), ()
    t = Table(node, where, ("shape", "parts", "mount_stiffness"))
    if isinstance(t.table.get("shape"), Mapping) and "chain" in t.table["shape"]:
        raise SceneError(f"{where}: a chain is no probe of a scene; write [arm].")
    if isinstance(t.table.get("shape"), Mapping) and "dome" in t.table["shape"]:
        raise SceneError(f"{where}: a dome is no probe of a scene; write [sensor].")
    shape = beside(parse_probe_shape(t.table.get("shape"), where), path)
    return shape, tuple(_body(row, path, f"{path} [[probe.parts]] {i + 1}", "offset") for i,
                        row in enumerate(t.rows("parts")))


def parse_mount(tree: Mapping[str, Any], path: Path) -> float | None:
    """``mount_stiffness`` of ``[probe]`` [N/m], or None for a rigid mount.

    Raises:
        SceneError: not a stiffness, or the scene makes no touches of a dataset with it.
    """
    node = tree.get("probe")
    if not isinstance(node, Mapping) or "mount_stiffness" not in node:
        return None
    if "touches" not in tree:
        raise SceneError(f"{path} [probe]: mount_stiffness is {node['mount_stiffness']!r}, but there is no [touches]; "
                         f"a [press] moves the probe itself. Take mount_stiffness out.")
    return Table(node, f"{path} [probe]", tuple(node)).number("mount_stiffness", 0.0, 1.0, 1e9, "N/m")


def parse_obstacles(node: Any, path: Path) -> tuple[RigidBody, ...]:
    """The ``[[obstacles]]``."""
    if not isinstance(node, list):
        raise SceneError(f"{path}: obstacles is {node!r}; it must be a list of tables: write [[obstacles]] for each.")
    return tuple(_body(row, path, f"{path} [[obstacles]] {i + 1}", "pose") for i, row in enumerate(node))


def _body(node: Any, path: Path, where: str, place: str) -> RigidBody:
    t = Table(node, where, ("shape", place, "rotation", "friction"))
    shape = beside(parse_probe_shape(t.table.get("shape"), where), path)
    if place not in t.table:
        raise SceneError(f"{where}: {place} is missing; give where its origin is, {place} = [x, y, z] in metres"
                         f"{', in the frame of the probe.' if place == 'offset' else ', in the world.'}")
    friction = t.number("friction", 0.0, 0.0, MAX_FRICTION) if "friction" in t.table else None
    return RigidBody(shape, t.vector(place, None), _turn(where, "rotation", t.table.get("rotation", ORIGIN)), friction)


def _turn(where: str, key: str, value: Any) -> Vector:
    vector = numbers(where, key, value, 3)
    angle = math.sqrt(sum(v * v for v in vector))
    if angle > 2.0 * math.pi + 1e-9:
        raise SceneError(f"{where}: {key} is {list(vector)}, a turn of {angle:.4g} rad; it is a rotation vector (axis "
                         f"times angle in radians, "
                         "e.g. [0, 0, 1.5708] for a quarter turn about z), of 2 pi at most.")
    return vector


def parse_press(node: Any, path: Path) -> PressSpec:
    """``[press]``: ``from`` and ``to``, or ``path``; see `PressSpec`."""
    where = f"{path} [press]"
    own = ("from", "to", "path", "rotation", "frames")
    t = Table(node, where, (*own, "hold", "retract"))
    if "path" in t.table:
        for key in ("from", "to"):
            if key in t.table:
                raise SceneError(f"{where}: there is a path, and {key}; give either path = [[x, y, z], ..] or "
                                 f"from and to.")
        rows = t.table["path"]
        if not isinstance(rows, list) or len(rows) < 2 or len(rows) > 10_000:
            raise SceneError(f"{where}: path is {rows!r}; give 2 to 10000 points, e.g. path = [[0, 0, 0.07], [0, 0, "
                             f"0.065], [0.01, 0, 0.065]].")
        points = tuple(numbers(where, f"path[{i}]", row, 3) for i, row in enumerate(rows))
    else:
        points = (t.vector("from", None), t.vector("to", None))
    rotation = _rotations(where, t.table, len(points))
    for i, (a, b) in enumerate(itertools.pairwise(points)):
        turned = rotation is not None and rotation[i] != rotation[i + 1]
        if a == b and not turned:
            what = f"path[{i}] and path[{i + 1}]" if "path" in t.table else "from and to"
            raise SceneError(f"{where}: {what} are both {list(a)}; the probe must move.")
    if rotation is None and points[0] == points[1]:
        raise SceneError(f"{where}: the path begins on the spot, so the probe has no direction to point to; "
                         f"give rotation.")
    frames = t.table.get("frames", 10)
    if isinstance(frames, list):
        if len(frames) != len(points) - 1:
            raise SceneError(f"{where}: frames has {len(frames)} numbers, but the path has {len(points) - 1} parts; "
                             f"give one number a part, or one for all.")
        counts = tuple(whole(where, f"frames[{i}]", n, 1, 10_000) for i, n in enumerate(frames))
    else:
        counts = (whole(where, "frames", frames, 1, 10_000),) * (len(points) - 1)
    return read(PressSpec, node, where, own, path=points, frames=counts, rotation=rotation)


def _rotations(where: str, table: Mapping[str, Any], points: int) -> tuple[Vector, ...] | None:
    if "rotation" not in table:
        return None
    value = table["rotation"]
    if not isinstance(value, list) or not value or not isinstance(value[0], list):
        return (_turn(where, "rotation", value),) * points
    if len(value) != points:
        raise SceneError(f"{where}: rotation has {len(value)} rotation vectors, but the path has {points} points; give "
                         f"one a point, or a single one for all.")
    return tuple(_turn(where, f"rotation[{i}]", row) for i, row in enumerate(value))
