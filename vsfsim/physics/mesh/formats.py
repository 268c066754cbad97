"""Readers of surface meshes: OBJ, PLY, STL and OFF become corners, triangles and a colour.

Formats: Wavefront OBJ (appendix B1 of the Advanced Visualizer manual), PLY (Turk 1994), STL (3D Systems 1989), OFF
(Geomview). An index is resolved where it stands in the file, and what a header announces is compared with what follows.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import MeshError

FORMATS = (".obj", ".ply", ".stl", ".off")
"""File formats that are read."""
_FACE_COLOURS = "The colours of the file's faces are not used: give colours to its vertices."


@dataclass(frozen=True)
class Facets:
    """A surface as its file has it, in units of the file."""

    vertices: np.ndarray
    """Corners (n, 3)."""
    faces: np.ndarray
    """Triangles (f, 3); a polygon was cut into triangles."""
    colours: np.ndarray | None = None
    """Of the corners, sRGB in 0..1 (n, 3), or None."""
    notes: tuple[str, ...] = field(default=())
    """What of the file is not used, one sentence each."""


def parse(content: bytes, path: Path) -> Facets:
    """Read a mesh; the ending of ``path`` names the format.

    Raises:
        MeshError: the content is not of that format, ends too soon, or names corners that it does not have.
    """
    kind = path.suffix[1:].upper()
    try:
        found = {"OBJ": _obj, "PLY": _ply, "STL": _stl, "OFF": _off}[kind](content, path)
    except _Bad as problem:
        raise MeshError(f"mesh file '{path}' cannot be understood as {kind}: {problem}. Export it again.") from None
    except (ValueError, IndexError, KeyError, OverflowError, UnicodeDecodeError, MemoryError, TypeError) as problem:
        raise MeshError(f"mesh file '{path}' cannot be understood as {kind}: {type(problem).__name__}: "
                        f"{str(problem)[:200]}. Export it again.") from problem
    if not len(found.faces):
        raise MeshError(f"mesh file '{path}' has no faces; a closed triangle surface is needed (a point cloud is "
                        "not enough).")
    return found


class _Bad(Exception):
    """What is wrong with the content."""


# ---------------------------------------------------------------------------------------------- OBJ


def _obj(content: bytes, path: Path) -> Facets:
    text = re.sub(r"\\\r?\n", " ", content.decode("utf-8", errors="replace"))
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    materials: set[str] = set()
    textured, others = False, set[str]()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] == "v":
            if len(words) < 4:
                raise _Bad(f"line {number} gives a vertex {len(words) - 1} numbers, and it needs three")
            vertices.append([float(w) for w in words[1:]])
        elif words[0] in ("f", "fo"):
            polygons.append([_obj_corner(word, len(vertices), number) for word in words[1:]])
        elif words[0] == "usemtl":
            materials.add(" ".join(words[1:]))
        textured = textured or words[0] == "vt"
        others |= {words[0]} & {"p", "l", "curv", "curv2", "surf"}
    points = np.array([v[:3] for v in vertices], float).reshape(-1, 3)
    _check_indices(polygons, len(points))
    # x y z r g b, or x y z w r g b; a lone fourth number is the weight of a rational curve
    tail = [v[-3:] for v in vertices if len(v) in (6, 7)]
    colours = np.array(tail, float) if tail and len(tail) == len(vertices) else None
    notes = []
    if materials:
        notes.append(f"The file's {len(materials)} materials ({', '.join(sorted(materials)[:3])}"
                     f"{', ...' if len(materials) > 3 else ''}) are not used: a scan is one body of the scene's "
                     "material and of one colour.")
    elif textured:
        notes.append("The file's texture coordinates are not used: a scan has one colour.")
    if others:
        notes.append(f"The file's points, lines and curved surfaces ({', '.join(sorted(others))}) are not used: a scan "
                     f"is its faces.")
    return Facets(points, _triangles(points, polygons), _unit(colours), tuple(notes))


def _obj_corner(word: str, known: int, line: int) -> int:
    index = int(word.split("/", 1)[0])
    # a negative index counts back from the last vertex before this line
    found = index - 1 if index > 0 else known + index
    if index == 0 or found < 0:
        raise _Bad(f"line {line} names vertex {index}, and {known} come before it")
    return found


# ---------------------------------------------------------------------------------------------- PLY

_PLY_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
              "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
              "double": "f8", "float64": "f8"}


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str, str | None]]  # name, type, type of the length of a list


def _ply(content: bytes, path: Path) -> Facets:
    header, mark, body = content.partition(b"end_header")
    if not content.startswith(b"ply") or not mark:
        raise _Bad("it has no PLY header, which begins with 'ply' and ends with 'end_header'")
    body = body[body.index(b"\n") + 1:] if b"\n" in body else b""
    form, elements = "", list[_Element]()
    for line in header.decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            elements[-1].properties.append((words[4], _PLY_TYPES[words[3]], _PLY_TYPES[words[2]]))
        elif words[:1] == ["property"]:
            elements[-1].properties.append((words[2], _PLY_TYPES[words[1]], None))
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise _Bad(f"its format is '{form}'; ascii, binary_little_endian and binary_big_endian are known")
    if any(e.count < 0 or e.count > len(content) for e in elements):
        raise _Bad("its header announces more rows than the file has bytes")
    rows = {}
    words_left: list[bytes] = body.split() if form == "ascii" else []
    at = 0
    for element in elements:
        order = ">" if form == "binary_big_endian" else "<"
        columns, at = (_ply_ascii(element, words_left, at) if form == "ascii"
                       else _ply_binary(element, body, at, order))
        rows[element.name] = columns
    left = len(words_left) - at if form == "ascii" else len(body[at:].strip(b"\r\n\0 "))
    if left:
        raise _Bad(f"its header announces {', '.join(f'{e.count} of {e.name}' for e in elements)}, and more data "
                   "follow: counts and content do not agree")
    corner = rows["vertex"]
    points = np.stack([np.asarray(corner[axis], float) for axis in "xyz"], axis=1)
    polygons = next((v for k, v in rows.get("face", {}).items() if k in ("vertex_indices", "vertex_index")), [])
    polygons = [list(map(int, p)) for p in polygons] + _strips(rows.get("tristrips", {}).get("vertex_indices", []))
    _check_indices(polygons, len(points))
    colours = None
    names = next((n for n in (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"),
                              ("r", "g", "b")) if set(n) <= set(corner)), None)
    notes = []
    if names:
        colours = _unit(np.stack([np.asarray(corner[n], float) for n in names], axis=1),
                        whole=np.asarray(corner[names[0]]).dtype.kind in "iu")
    elif {"red", "green", "blue"} <= set(rows.get("face", {})):
        notes.append(_FACE_COLOURS)
    return Facets(points, _triangles(points, polygons), colours, tuple(notes))


def _ply_ascii(element: _Element, words: list[bytes], at: int) -> tuple[dict[str, Any], int]:
    columns: dict[str, Any] = {name: [] for name, _, _ in element.properties}
    if all(length is None for _, _, length in element.properties):
        width = len(element.properties)
        table = np.array(words[at:at + width * element.count], float)
        if len(table) < width * element.count:
            raise _too_short(element, len(table) // max(width, 1))
        table = table.reshape(element.count, width)
        return {name: table[:, k].astype(kind) for k, (name, kind, _) in enumerate(element.properties)}, \
            at + width * element.count
    for row in range(element.count):
        for name, kind, length in element.properties:
            count = 1
            if length is not None:
                if at >= len(words):
                    raise _too_short(element, row)
                count, at = int(words[at]), at + 1
            if count < 0 or at + count > len(words):
                raise _too_short(element, row)
            values = [float(w) if kind[0] == "f" else int(w) for w in words[at:at + count]]
            columns[name].append(values[0] if length is None else values)
            at += count
    return columns, at


def _ply_binary(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, Any], int]:
    # Rows of one width are read at once: without lists, or where all lists are as long as those of the first row.
    width: list[tuple[Any, ...]] = []
    place = at
    for name, kind, length in element.properties:
        if length is None:
            width.append((name, order + kind))
            place += np.dtype(kind).itemsize
            continue
        if place + np.dtype(length).itemsize > len(body):
            if element.count:
                raise _too_short(element, 0)
            break
        count = int(np.frombuffer(body, order + length, 1, place)[0])
        width += [(f"length of {name}", order + length), (name, order + kind, (max(count, 0),))]
        place += np.dtype(length).itemsize + max(count, 0) * np.dtype(kind).itemsize
    row = np.dtype(width)
    if element.count and at + row.itemsize * element.count <= len(body):
        table = np.frombuffer(body, row, element.count, at)
        if all((table[f"length of {n}"] == table[n].shape[1]).all() for n, _, length in element.properties if length):
            return {name: table[name].astype(kind) for name, kind, _ in element.properties}, \
                at + row.itemsize * element.count
    columns: dict[str, Any] = {name: [] for name, _, _ in element.properties}
    for n in range(element.count):
        for name, kind, length in element.properties:
            count = 1
            if length is not None:
                if at + np.dtype(length).itemsize > len(body):
                    raise _too_short(element, n)
                count = int(np.frombuffer(body, order + length, 1, at)[0])
                at += np.dtype(length).itemsize
            if count < 0 or at + count * np.dtype(kind).itemsize > len(body):
                raise _too_short(element, n)
            values = np.frombuffer(body, order + kind, count, at)
            columns[name].append(values[0] if length is None else values)
            at += count * np.dtype(kind).itemsize
    return columns, at


def _too_short(element: _Element, rows: int) -> _Bad:
    return _Bad(f"its header announces {element.count} of {element.name}, and it ends after {rows}")


def _strips(rows: Iterable[Sequence[int]]) -> list[list[int]]:
    out = []
    for strip in rows:
        part: list[int] = []
        for index in [*map(int, strip), -1]:
            if index >= 0:
                part.append(index)
                continue
            out += [part[k:k + 3] if k % 2 == 0 else [part[k + 1], part[k], part[k + 2]] for k in range(len(part) - 2)]
            part = []
    return out


# ---------------------------------------------------------------------------------------------- STL, OFF


def _stl(content: bytes, path: Path) -> Facets:
    # a binary file may begin with "solid", too: what tells is the count at byte 80, which fixes the file's length
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    text = content.lstrip()[:5].lower() == b"solid" and b"facet" in content[:2000].lower() and (
        84 + 50 * count != len(content))
    notes: tuple[str, ...] = ()
    if text:
        words = content.decode("utf-8", errors="replace").lower()
        if "endsolid" not in words:
            raise _Bad("it ends without 'endsolid'")
        corners = re.findall(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", words)
        facets = len(re.findall(r"\bendfacet\b", words))
        if len(corners) != 3 * facets or facets != len(re.findall(r"\bfacet\s+normal\b", words)):
            raise _Bad(f"it has {len(corners)} vertices in {facets} facets, and each facet needs three")
        points = np.array(corners, float).reshape(-1, 3)
    else:
        if count < 0:
            raise _Bad(f"it has {len(content)} bytes; a binary STL has 84 and 50 a triangle, a text has 'solid'")
        have = (len(content) - 84) / 50
        if count > have or len(content[84 + 50 * count:].strip(b"\0\r\n ")):
            raise _Bad(f"its header announces {count} triangles, and it holds {have:g}")
        row = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
        table = np.frombuffer(content, row, count, 84)
        points = table["corner"].reshape(-1, 3).astype(float)
        if table["attribute"].any():
            notes = (_FACE_COLOURS,)
    return Facets(points, np.arange(len(points)).reshape(-1, 3), notes=notes)


def _off(content: bytes, path: Path) -> Facets:
    lines = [line.split("#", 1)[0].split() for line in content.decode("utf-8", errors="replace").splitlines()]
    rows = [line for line in lines if line]
    if not rows or rows[0][0] not in ("OFF", "COFF"):
        raise _Bad("it does not begin with 'OFF' or 'COFF'")
    rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
    corners, faces = int(rows[0][0]), int(rows[0][1])
    if corners < 0 or faces < 0 or len(rows) != 1 + corners + faces:
        raise _Bad(f"its header announces {corners} vertices and {faces} faces, and {len(rows) - 1} rows follow")
    table = [[float(w) for w in row] for row in rows[1:1 + corners]]
    points = np.array([row[:3] for row in table], float).reshape(-1, 3)
    colours = np.array([row[3:6] for row in table], float) if table and min(map(len, table)) >= 6 else None
    polygons = []
    for row in rows[1 + corners:]:
        if len(row) < 1 + int(row[0]):
            raise _Bad(f"a face announces {row[0]} corners and has {len(row) - 1}")
        polygons.append([int(w) for w in row[1:1 + int(row[0])]])
    _check_indices(polygons, len(points))
    coloured = any(len(row) > 1 + int(row[0]) for row in rows[1 + corners:])
    return Facets(points, _triangles(points, polygons), _unit(colours), (_FACE_COLOURS,) if coloured else ())


# ---------------------------------------------------------------------------------------------- polygons


def _check_indices(polygons: list[list[int]], count: int) -> None:
    for polygon in polygons:
        if polygon and not (0 <= min(polygon) and max(polygon) < count):
            wrong = min(polygon) if min(polygon) < 0 else max(polygon)
            raise _Bad(f"a face names vertex {wrong}, counted from 0, and there are {count}")


def _triangles(points: np.ndarray, polygons: list[list[int]]) -> np.ndarray:
    out: list[Sequence[int]] = []
    for polygon in polygons:
        if len(polygon) == 3:
            out.append(polygon)
        elif len(polygon) > 3:
            out += _cut(points[polygon], polygon)
    return np.array(out, np.int64).reshape(-1, 3)


def _cut(at: np.ndarray, polygon: list[int]) -> list[list[int]]:
    """Triangles of a polygon: a fan if it is convex, else its ears, cut off one by one (Meisters 1975)."""
    normal = np.cross(at, np.roll(at, -1, axis=0)).sum(axis=0)  # Newell's
    longest = float(np.linalg.norm(normal))
    if not np.isfinite(longest) or longest == 0.0:
        return [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    axis = int(np.abs(normal).argmax())
    flat = np.delete(at, axis, axis=1) * (1.0 if (normal[axis] > 0) == (axis != 1) else [-1.0, 1.0])

    def turn(a: int, b: int, c: int) -> float:
        u, v = flat[b] - flat[a], flat[c] - flat[a]
        return float(u[0] * v[1] - u[1] * v[0])

    ring = list(range(len(polygon)))
    if all(turn(ring[k - 1], ring[k], ring[(k + 1) % len(ring)]) >= 0.0 for k in range(len(ring))):
        return [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    out = []
    while len(ring) > 3:
        for k in range(len(ring)):
            a, b, c = ring[k - 1], ring[k], ring[(k + 1) % len(ring)]
            if turn(a, b, c) > 0.0 and not any(
                min(turn(a, b, p), turn(b, c, p), turn(c, a, p)) >= 0.0 for p in ring if p not in (a, b, c)
            ):
                break
        else:
            k = 0  # a polygon that crosses itself has no ear
        out.append([polygon[ring[k - 1]], polygon[ring[k]], polygon[ring[(k + 1) % len(ring)]]])
        del ring[k]
    return [*out, [polygon[r] for r in ring]]


def _unit(colours: np.ndarray | None, *, whole: bool | None = None) -> np.ndarray | None:
    """Colours in 0..1 (n, 3), of bytes or of fractions."""
    if colours is None or not len(colours) or not np.isfinite(colours).all():
        return None
    bytes_ = bool(colours.max() > 1.0) if whole is None else whole
    return np.clip(colours / (255.0 if bytes_ else 1.0), 0.0, 1.0)
