"""The rigid side of a scene: the probe, what moves with it, what stands in the world, and the path of a press."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from vsfsim.core.errors import SceneError
from vsfsim.core.material import parse_law
from vsfsim.core.shape import MeshFile, ProbeShape, Sphere, parse_probe_shape
from vsfsim.core.table import Angle, Friction, Rows, Vector, between, check_keys, typed, value

ORIGIN: Vector = (0.0, 0.0, 0.0)
MAX_BODIES = 64  # probe, parts and obstacles together; every contact point is compared with each of them
Frames = Annotated[int, between(1, 10_000, whole=True)]
Turn = Annotated[tuple[Angle, Angle, Angle], msgspec.Meta(
    description="3 numbers from -2 pi to 2 pi, a rotation vector: axis times angle in radians, e.g. [0, 0, 1.5708]")]
Points = Annotated[tuple[Vector, ...], msgspec.Meta(
    min_length=2, max_length=10_000, description="2 to 10000 points, e.g. [[0, 0, 0.07], [0, 0, 0.065]]")]


@dataclass(frozen=True)
class RigidBody:
    """A rigid body at a fixed place: an ``[[obstacles]]`` in the world, or a ``[[probe.parts]]`` in the probe's
    frame."""

    shape: ProbeShape
    """Of the body."""
    position: Vector
    """Of its origin (3,) [m]."""
    rotation: Turn = ORIGIN
    """Rotation vector (3,) [rad]."""
    friction: Friction | None = None
    """Coulomb coefficient against the object [-], or None for that of the object."""


@dataclass(frozen=True)
class PressSpec:
    """``[press]``: the path of the probe's origin, and its rotation."""

    path: tuple[Vector, ...]
    """Corner points (k >= 2, 3) [m], world; straight in between."""
    frames: tuple[int, ...]
    """Equilibria on each of the k - 1 parts, the last of them at its end; the first point itself is no frame."""
    hold: Annotated[int, between(0, 10_000, whole=True)] = 0
    """Frames that stay at the last point."""
    retract: Annotated[int, between(0, 10_000, whole=True)] = 0
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


def parse_probe(node: Any, path: Path, *, touches: bool) -> tuple[
        ProbeShape, tuple[RigidBody, ...], dict[str, Any]]:
    """Shape and parts of ``[probe]``, and fields of the scene: the stiffness of the mount [N/m], None for a rigid one,
    and the law of contact. Without such a table it is a ball of 20 mm radius.

    Args:
        touches: whether the scene makes touches of a dataset.

    Raises:
        SceneError: an unknown key, a value that is not allowed, or a mount that nothing uses.
    """
    where = f"{path} [probe]"
    if node is None:
        return Sphere(0.02), (), {}
    table = check_keys(node, where, ("shape", "parts", "mount_stiffness", "law"))
    mount = table.get("mount_stiffness")
    if mount is not None and not touches:
        raise SceneError(f"{where}: mount_stiffness is {mount!r}, but there is no [touches]; a [press] moves the probe "
                         f"itself. Take mount_stiffness out.")
    stiffness = value(mount, Annotated[float, between(1.0, 1e9, "N/m")] | None, f"{where}: mount_stiffness")
    return (beside(parse_probe_shape(table.get("shape"), where), path),
            parse_bodies(table.get("parts", []), path, "probe.parts", "offset"),
            {"mount_stiffness": stiffness, "contact_law": parse_law(table["law"], where) if "law" in table else None})


def parse_bodies(node: Any, path: Path, name: str, place: str) -> tuple[RigidBody, ...]:
    """The bodies of a list of tables, ``[[name]]``, each at its ``place``."""
    out = []
    for k, row in enumerate(value(node, Rows, f"{path}: {name}"), start=1):
        where, own = f"{path} [[{name}]] {k}", ("shape", place)
        table = check_keys(row, where, (*own, "rotation", "friction"))
        shape = beside(parse_probe_shape(table.get("shape"), where), path)
        out.append(typed(row, RigidBody, where, also=own, shape=shape,
                         position=value(table.get(place), Vector, f"{where}: {place}")))
    return tuple(out)


def parse_press(node: Any, path: Path) -> PressSpec:
    """``[press]``: ``from`` and ``to``, or ``path``; see `PressSpec`."""
    where, own = f"{path} [press]", ("from", "to", "path", "rotation", "frames")
    table = check_keys(node, where, (*own, "hold", "retract"))
    if "path" in table and table.keys() & {"from", "to"}:
        raise SceneError(f"{where}: there is a path, and from or to; give either path = [[x, y, z], ..] or from and "
                         f"to.")
    points: tuple[Vector, ...]
    if "path" in table:
        points = value(table["path"], Points, f"{where}: path")
        names = [f"path[{i}]" for i in range(len(points))]
    else:
        names = ["from", "to"]
        points = tuple(value(table.get(name), Vector, f"{where}: {name}") for name in names)
    rotation = table.get("rotation")
    if rotation is not None:
        each = isinstance(rotation, list) and bool(rotation) and isinstance(rotation[0], list)
        if each and len(rotation) != len(points):
            raise SceneError(f"{where}: rotation has {len(rotation)} rotation vectors, but the path has {len(points)} "
                             f"points; give one a point, or a single one for all.")
        rotation = (value(rotation, tuple[Turn, ...], f"{where}: rotation") if each
                    else (value(rotation, Turn, f"{where}: rotation"),) * len(points))
    for i, (a, b) in enumerate(itertools.pairwise(points)):
        if a == b and (rotation is None or rotation[i] == rotation[i + 1]):
            raise SceneError(f"{where}: {names[i]} and {names[i + 1]} are both {list(a)}; the probe must move.")
    frames = table.get("frames", 10)
    counts = value(frames, list[Frames] | Frames, f"{where}: frames")
    if isinstance(frames, list) and len(frames) != len(points) - 1:
        raise SceneError(f"{where}: frames has {len(frames)} numbers, but the path has {len(points) - 1} parts; give "
                         f"one number a part, or one for all.")
    return typed(node, PressSpec, where, also=own, path=points, rotation=rotation,
                 frames=tuple(counts) if isinstance(frames, list) else (counts,) * (len(points) - 1))
