"""Readers of surface meshes: OBJ, PLY and STL become corners and triangles.

Formats: Wavefront OBJ (appendix B1 of the Advanced Visualizer manual), PLY (Turk 1994), STL (3D Systems 1989).
An index is resolved where it stands in the file, and what a header announces is compared with what follows.
What programs read in different ways (a word, a number, the end of a line) is refused: a corner more or less shifts
every index behind it.
"""

from __future__ import annotations

import codecs
import operator
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import MeshError


@dataclass(frozen=True)
class Facets:
    """A surface as its file has it, in units of the file."""

    vertices: np.ndarray
    """Corners (n, 3)."""
    faces: np.ndarray
    """Triangles (f, 3); a polygon was cut into triangles."""


def parse(content: bytes, path: Path) -> Facets:
    """Read a mesh; the ending of ``path`` names the format.

    Raises:
        MeshError: the content is not of that format, ends too soon, or names corners that it does not have.
    """
    kind = path.suffix[1:].upper()
    try:
        found = {"OBJ": _obj, "PLY": _ply, "STL": _stl}[kind](content)
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


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf(?:inity)?)"
_BREAKS = re.compile("[\0\v\f\x1c-\x1e\x85\u2028\u2029\ufeff]")
"""Characters at which some programs begin a new line, and others do not, or that only some see."""


def _lines(content: bytes) -> list[str]:
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise _Bad("it begins with the byte order mark of UTF-16, and UTF-8 or ASCII is read")
    text = content.removeprefix(codecs.BOM_UTF8).decode("utf-8", errors="replace").replace("\r\n", "\n")
    if odd := _BREAKS.search(text):
        line = text.count("\n", 0, odd.start()) + 1
        raise _Bad(f"line {line} has the character U+{ord(odd[0]):04X}, where programs differ on what a line is")
    if "\r" in text and "\n" in text:
        raise _Bad("some of its lines end in a carriage return alone and others in a line feed, and programs differ on "
                   "what a line is")
    return text.replace("\r", "\n").split("\n")


def _number(word: str, line: int, kind: Callable[[str], Any]) -> Any:
    try:
        if "_" not in word and word.isascii():
            return kind(word)
    except ValueError:
        pass
    raise _Bad(f"line {line} has '{word[:40]}' where {'an index' if kind is int else 'a number'} belongs")


_OBJ_KNOWN = {"v", "f", "fo", "vt", "vn", "vp", "g", "o", "s", "mg", "mtllib", "usemtl", "usemap", "maplib", "bevel",
              "c_interp", "d_interp", "lod", "shadow_obj", "trace_obj", "cstype", "deg", "bmat", "step", "ctech",
              "stech", "parm", "trim", "hole", "scrv", "sp", "con", "end", "p", "l", "curv", "curv2", "surf"}


def _obj(content: bytes) -> Facets:
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(_lines(content), 1):
        if line.rstrip().endswith("\\"):
            raise _Bad(f"line {number} ends in a backslash, and programs differ on whether the next line belongs to it")
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        if words[0] not in _OBJ_KNOWN:
            raise _Bad(f"line {number} begins with '{words[0][:40]}', which is not a word of OBJ that is known")
        if words[0] == "v":
            if len(words) not in (4, 5, 7, 8):
                raise _Bad(f"line {number} gives a vertex {len(words) - 1} numbers, and it needs three")
            # x y z, x y z w, x y z r g b, or x y z w r g b
            vertices.append([_number(w, number, float) for w in words[1:]][:3])
        elif words[0] in ("f", "fo"):
            given = [_number(word.split("/", 1)[0], number, int) for word in words[1:]]
            # a negative index counts back from the last vertex before this line
            polygons.append([index - 1 if index > 0 else len(vertices) + index for index in given])
            if 0 in given or min(polygons[-1], default=0) < 0:
                raise _Bad(f"line {number} names vertex {0 if 0 in given else min(given)}, and {len(vertices)} come "
                           "before it")
    points = np.array(vertices, float).reshape(-1, 3)
    return Facets(points, _triangles(points, polygons))


# ---------------------------------------------------------------------------------------------- PLY

_PLY_TYPES = {"char": "b", "int8": "b", "uchar": "B", "uint8": "B", "short": "h", "int16": "h", "ushort": "H",
              "uint16": "H", "int": "i", "int32": "i", "uint": "I", "uint32": "I", "float": "f", "float32": "f",
              "double": "d", "float64": "d"}
"""Of each name of a type its letter in `struct`."""


def _ply(content: bytes) -> Facets:
    content = content.removeprefix(codecs.BOM_UTF8)
    head = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    end = head and re.search(rb"(?:\r\n|[\r\n])end_header[ \t]*" + head[1], content)
    if not end:
        raise _Bad("it has no PLY header, which begins with the line 'ply' and ends with the line 'end_header'")
    body, form = content[end.end():], ""
    # of each element its properties, of each property its type and that of a list's length
    elements: list[tuple[str, int, list[tuple[str, str, str | None]]]] = []
    for number, line in enumerate(_lines(content[:end.start()])[1:], 2):
        match line.split():
            case ["format", form, *_]:
                pass
            case ["element", name, given] if given.isascii() and given.isdecimal():
                elements.append((name, int(given), []))
            case ["property", "list", length, kind, name]:
                elements[-1][2].append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name]:
                elements[-1][2].append((name, _PLY_TYPES[kind], None))
            case ["comment" | "obj_info", *_] | []:
                pass
            case _:
                raise _Bad(f"line {number} of its header, '{line[:40]}', is not known")
    names = [(name, *of) for name, _, own in elements for of in [(), *((one,) for one, _, _ in own)]]
    if len(set(names)) < len(names):
        raise _Bad("its header names an element or a property twice")
    if form not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise _Bad(f"its format is '{form}'; ascii, binary_little_endian and binary_big_endian are known")
    if ("tristrips",) in names:
        raise _Bad("it has strips of triangles, and single faces are read")
    counts = ", ".join(f"{count} of {name}" for name, count, _ in elements)
    if any(count > len(content) for _, count, _ in elements):
        raise _Bad("its header announces more rows than the file has bytes")
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    source = _PlyBody(order, body if order else body.split())
    rows: dict[str, dict[str, tuple[Any, ...]]] = {}
    try:
        for name, count, own in elements:
            table = [[source.take(kind, source.take(length, 1)[0]) if length else source.take(kind, 1)[0]
                      for _, kind, length in own] for _ in range(count)]
            rows[name] = dict(zip((one for one, _, _ in own), zip(*table)))
    except IndexError:
        raise _Bad(f"its header announces {counts}, and less follows: counts and content do not agree") from None
    left = source.left[source.at:]
    if left.strip(b"\r\n\0 ") if isinstance(left, bytes) else left:
        raise _Bad(f"its header announces {counts}, and more follows: counts and content do not agree")
    corner = rows["vertex"]
    points = np.stack([np.asarray(corner[axis], float) for axis in "xyz"], axis=1)
    faces = next((v for k, v in rows.get("face", {}).items() if k in ("vertex_indices", "vertex_index")), ())
    polygons = [list(map(operator.index, face)) for face in faces]
    return Facets(points, _triangles(points, polygons))


@dataclass
class _PlyBody:
    """What follows a header: words of an ASCII file, or bytes in an ``order`` of `struct`."""

    order: str
    left: Any
    at: int = 0

    def take(self, kind: str, many: int) -> tuple[Any, ...]:
        """The next numbers of a kind; raises IndexError if fewer are left."""
        stop = self.at + many * (struct.calcsize(f"<{kind}") if self.order else 1)
        part, self.at = self.left[self.at:stop], stop
        if many < 0 or stop > len(self.left):
            raise IndexError
        if self.order:
            return struct.unpack(f"{self.order}{many}{kind}", part)
        found = tuple(map(float, part))
        if kind not in "fd" and not all(map(float.is_integer, found)):
            raise _Bad("its header announces whole numbers, and others follow")
        return found if kind in "fd" else tuple(map(int, found))


# ---------------------------------------------------------------------------------------------- STL


_STL_VERTEX = rf"\s+vertex\s+({_NUMBER})\s+({_NUMBER})\s+({_NUMBER})"
_STL_FACET = re.compile(r"\s*facet\s+normal(?:\s+\S+){3}\s+outer\s+loop" + 3 * _STL_VERTEX
                        + r"\s+endloop\s+endfacet(?!\S)", re.ASCII)


def _stl(content: bytes) -> Facets:
    # a binary file may begin with "solid", too: what tells is the count at byte 80, which fixes the file's length
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    text = (content.removeprefix(codecs.BOM_UTF8).lstrip()[:5].lower() == b"solid"
            and b"facet" in content[:2000].lower() and 84 + 50 * count != len(content))
    if text:
        lines = [line.strip().lower() for line in _lines(content)]
        names = [re.match(r"(?:end)?solid\b", line) for line in lines]
        if [name[0] for name in names if name] != ["solid", "endsolid"] * (sum(map(bool, names)) // 2):
            raise _Bad("it ends without 'endsolid', or has one without 'solid'")
        words = " ".join(line for line, name in zip(lines, names, strict=True) if not name)
        corners = _STL_FACET.findall(words)
        if left := _STL_FACET.sub("", words).strip():
            raise _Bad(f"it has '{left[:60]}' outside of facets, which have a normal and three vertices each")
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
    return Facets(points, np.arange(len(points)).reshape(-1, 3))


# ---------------------------------------------------------------------------------------------- polygons


def _triangles(points: np.ndarray, polygons: list[list[int]]) -> np.ndarray:
    out: list[list[int]] = []
    for polygon in polygons:
        if polygon and not (0 <= min(polygon) and max(polygon) < len(points)):
            wrong = min(polygon) if min(polygon) < 0 else max(polygon)
            raise _Bad(f"a face names vertex {wrong}, counted from 0, and there are {len(points)}")
        if len(polygon) == 3:
            out.append(polygon)
        elif len(polygon) > 3:
            out += _cut(points[polygon], polygon)
    return np.array(out, np.int64).reshape(-1, 3)


def _cut(at: np.ndarray, polygon: list[int]) -> list[list[int]]:
    """Triangles of a convex polygon with corners ``at`` (k, 3): the fan about its first corner."""
    part = np.cross(at[1:-1] - at[0], at[2:] - at[0])
    if (part @ part.sum(axis=0) < 0.0).any():
        raise _Bad(f"a face of {len(polygon)} corners is not convex, and programs cut such a face in different ways; "
                   f"make triangles of it")
    return [[polygon[0], b, c] for b, c in pairwise(polygon[1:])]
