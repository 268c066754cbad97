"""Readers of mesh files: the right surface, or an error that says what does not fit."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import MeshFile
from vsfsim.physics.elements import gas
from vsfsim.physics.mesh.formats import parse
from vsfsim.physics.mesh.repair import read_surface
from vsfsim.physics.mesh.scan import fill_mesh_file

CUBE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
QUADS = [(4, 3, 2, 1), (5, 6, 7, 8), (1, 2, 6, 5), (2, 3, 7, 6), (3, 4, 8, 7), (4, 1, 5, 8)]


def obj_block(low: tuple[float, float, float], size: tuple[float, float, float]) -> str:
    """A block whose faces count back from its own last vertex."""
    corners = [tuple(low[k] + size[k] * c[k] for k in range(3)) for c in CUBE]
    return "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "".join(
        "f " + " ".join(str(i - 9) for i in quad) + "\n" for quad in QUADS)


def volume(content: str | bytes, name: str) -> float:
    data = content.encode() if isinstance(content, str) else content
    found = parse(data, Path(name))
    return gas.volume(found.vertices, found.faces)


def test_relative_indices_count_from_where_they_stand(tmp_path: Path) -> None:
    """Two parts of 100 x 100 x 30 and 40 x 40 x 30 mm, one on the other: the first was lost, the last read twice."""
    path = tmp_path / "two.obj"
    path.write_text(obj_block((-0.05, -0.05, 0.0), (0.1, 0.1, 0.03))
                    + obj_block((-0.02, -0.02, 0.03), (0.04, 0.04, 0.03)))
    surface = read_surface(MeshFile(str(path)))
    assert surface.extents == pytest.approx([0.1, 0.1, 0.06])
    solid = fill_mesh_file(MeshFile(str(path)), resolution=0.012)
    assert solid.volume() == pytest.approx(0.1 * 0.1 * 0.03 + 0.04 * 0.04 * 0.03, rel=0.02)


def obj_faces(corner: str, head: str = "") -> str:
    """A unit cube, each corner of a face written as ``corner`` with its number ``i``, or ``n`` counted from the end."""
    return head + "".join("v {} {} {}\n".format(*c) for c in CUBE) + "vt 0 0\nvn 0 0 -1\n" + "".join(
        "f " + " ".join(corner.format(i=i, n=i - 9) for i in quad) + "\n" for quad in QUADS)


@pytest.mark.parametrize("text", [
    obj_faces("{n}"), obj_faces("{n}/-1/-1"), obj_faces("{i}//1"), obj_faces("{i}/1"),
    obj_faces("{i}").replace("vn 0 0 -1\n", ""),
    obj_faces("{i}").replace("\n", "\r\n"), obj_faces("{i}").replace(" ", "\t"), obj_faces("{i}", "o a\ng b\ns off\n")])
def test_a_cube_is_a_cube_however_its_corners_are_named(text: str) -> None:
    """Normals that are wrong or missing do not matter: a face is wound by its corners."""
    assert volume(text, "a.obj") == pytest.approx(1.0)


BOM, CUBE_OBJ, CUBE_STL = b"\xef\xbb\xbf", obj_faces("{i}").encode(), trimesh.creation.box().export(
    file_type="stl_ascii").encode()


@pytest.mark.parametrize(("name", "data"), [
    ("a.obj", CUBE_OBJ), ("a.stl", CUBE_STL),
    ("a.ply", trimesh.creation.box().export(file_type="ply", encoding="ascii"))])
@pytest.mark.parametrize("change", [lambda d: BOM + d, lambda d: d.replace(b"\n", b"\r"),
                                    lambda d: d.replace(b"\n", b"\r\n")])
def test_a_byte_order_mark_and_every_end_of_a_line_are_read(name: str, data: bytes,
                                                            change: Callable[[bytes], bytes]) -> None:
    assert volume(change(data), name) == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "data", "word"), [
    ("a.obj", CUBE_OBJ.decode().encode("utf-16"), "byte order mark of UTF-16"),
    ("a.obj", CUBE_OBJ + BOM + CUBE_OBJ, r"line 17 has the character U\+FEFF"),
    ("a.obj", b"# made by a\rv 9 9 9\n" + CUBE_OBJ, "carriage return alone"),
    *[("a.obj", b"# made by a" + odd.encode() + b"v 9 9 9\n" + CUBE_OBJ, f"line 1 has the character U.{ord(odd):04X}")
      for odd in "\x0b\x0c\x85\u2028"],
    ("a.obj", b"# C:\\models\\\n" + CUBE_OBJ, "line 1 ends in a backslash"),
    ("a.obj", b"o name\\\n" + CUBE_OBJ, "line 1 ends in a backslash"),
    ("a.obj", CUBE_OBJ.replace(b"f 4 3", b"f 4\\\n3"), "line 11 ends in a backslash"),
    ("a.obj", b"V 9 9 9\n" + CUBE_OBJ, "line 1 begins with 'V'"),
    ("a.obj", b"call more.obj\n" + CUBE_OBJ, "line 1 begins with 'call'"),
    ("a.obj", b"v 1_0 0 0\n" + CUBE_OBJ, "line 1 has '1_0'"), ("a.obj", b"v 1 2 3 4 5\n" + CUBE_OBJ, "5 numbers"),
    ("a.obj", CUBE_OBJ + b"f 1 2 3.0\n", "'3.0' where an index belongs"),
    ("a.stl", CUBE_STL.replace(b"endloop", b"vertex 0 0 0 endloop", 1), "outside of facets"),
    ("a.stl", CUBE_STL.replace(b"endsolid", b"facet", 1), "ends without 'endsolid'")])
def test_what_programs_read_in_different_ways_is_refused_by_name(name: str, data: bytes, word: str) -> None:
    """Each of these gave a corner more or less to some reader, and shifted every index behind it."""
    with pytest.raises(MeshError, match=word):
        volume(data, name)


def ply_block(order: str, real: str = "float", index: str = "int", *, faces: int = 12) -> bytes:
    mesh, kind = trimesh.creation.box((1, 2, 3)), {"float": "f", "double": "d", "int": "i", "ushort": "H"}
    head = (f"ply\nformat {order} 1.0\nelement vertex 8\n" + "".join(f"property {real} {a}\n" for a in "xyz")
            + f"element face {faces}\nproperty list uchar {index} vertex_indices\nend_header\n").encode()
    if order == "ascii":
        return head + "".join(" ".join(map(str, row)) + "\n" for row in (
            *mesh.vertices.tolist(), *([3, *face] for face in mesh.faces.tolist()))).encode()
    sign = ">" if order == "binary_big_endian" else "<"
    return head + b"".join(struct.pack(f"{sign}3{kind[real]}", *v) for v in mesh.vertices) + b"".join(
        struct.pack(f"{sign}B3{kind[index]}", 3, *f) for f in mesh.faces)


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_of_every_order(order: str) -> None:
    for real, index in (("float", "int"), ("double", "ushort")):
        assert volume(ply_block(order, real, index), "a.ply") == pytest.approx(6.0)
    for faces in (6, 99):
        with pytest.raises(MeshError, match=r"announces .* counts and content do not agree"):
            volume(ply_block(order, faces=faces), "a.ply")
    if order != "ascii":
        one, other = (b"big", b"little") if "big" in order else (b"little", b"big")
        with pytest.raises(MeshError, match="cannot be understood as PLY"):
            volume(ply_block(order).replace(one, other, 1), "a.ply")


@pytest.mark.parametrize(("old", "new", "word"), [
    ("end_header", "vertices 9\nend_header", "line 9 of its header, 'vertices 9', is not known"),
    ("element face", "element vertex 0\nelement face", "names an element or a property twice"),
    ("property int z", "property int y", "names an element or a property twice"),
    ("list uchar int", "list uchar float", "integer"),
    ("property float x", "property int x", "announces whole numbers"),
    ("element vertex", "comment a\x0belement vertex", r"U\+000B"), ("element face", "element tristrips", "strips")])
def test_a_ply_whose_header_does_not_say_what_follows_is_refused(old: str, new: str, word: str) -> None:
    data = ply_block("ascii", "int" if "int z" in old else "float").decode()
    assert old in data
    with pytest.raises(MeshError, match=word):
        volume(data.replace(old, new, 1), "a.ply")


def test_polygons_are_cut_where_they_are_convex_and_refused_where_programs_differ() -> None:
    """Prisms over a hexagon and over an L of 3/4 of a square, whose ends are polygons of six corners."""
    hexagon = [(np.cos(a), np.sin(a)) for a in np.pi / 3.0 * np.arange(6)]
    prisms = ["".join(f"v {x} {y} {z}\n" for z in (0, 1) for x, y in ring) + "f 6 5 4 3 2 1\nf 7 8 9 10 11 12\n"
              + "".join(f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}\n" for k in range(6))
              for ring in (hexagon, [(0.5, 0.5), (0.5, 1), (0, 1), (0, 0), (1, 0), (1, 0.5)])]
    assert volume(prisms[0], "hexagon.obj") == pytest.approx(1.5 * np.sqrt(3.0))
    with pytest.raises(MeshError, match="a face of 6 corners is not convex"):
        volume(prisms[1], "l.obj")


def test_counts_are_compared_with_the_header() -> None:
    box = trimesh.creation.box((1, 2, 3))
    stl = box.export(file_type="stl")
    assert volume(b"solid facet".ljust(80) + stl[80:], "a.stl") == pytest.approx(6.0), "it is binary"
    for data, name, word in (
        (stl[:80] + struct.pack("<I", 13) + stl[84:], "a.stl", "announces 13 triangles, and it holds 12"),
        (stl[:80] + struct.pack("<I", 11) + stl[84:], "a.stl", "announces 11 triangles"),
        (stl[:-30], "a.stl", "announces 12 triangles"),
        (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "a.obj", "names vertex 3, counted from 0"),
        (b"v 0 0 0\nf -2 -1 -1\n", "a.obj", "line 2 names vertex -2"),
    ):
        with pytest.raises(MeshError, match=word):
            parse(data, Path(name))


@pytest.mark.parametrize("flips", [(1, -1), (-1, 1), (1, 1), (-1, -1)])
def test_a_part_inside_another_is_a_cavity_whatever_way_it_is_wound(flips: tuple[int, int], tmp_path: Path) -> None:
    outer, inner = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.04, 0.024))
    for ball, flip in zip((outer, inner), flips, strict=True):
        if flip < 0:
            ball.invert()
    trimesh.util.concatenate([outer, inner]).export(tmp_path / "b.stl")
    surface = read_surface(MeshFile(str(tmp_path / "b.stl")))
    assert surface.parts == 1
    solid = fill_mesh_file(MeshFile(str(tmp_path / "b.stl")), resolution=0.01)
    assert solid.volume() == pytest.approx(abs(outer.volume) - abs(inner.volume), rel=0.02)
    assert not any("departs" in note for note in solid.notes), "the cavity's surface is near the filling's"


def test_the_same_surface_gives_the_same_body_in_every_format(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    ball.vertices *= 1 + 0.1 * np.sin(90 * ball.vertices[:, :1])
    solids = []
    for suffix in ("stl", "ply", "obj"):
        ball.export(tmp_path / f"b.{suffix}")
        solids.append(fill_mesh_file(MeshFile(str(tmp_path / f"b.{suffix}")), resolution=0.01))
    again = fill_mesh_file(MeshFile(str(tmp_path / "b.stl")), resolution=0.01)
    assert np.array_equal(again.vertices, solids[0].vertices) and np.array_equal(again.tets, solids[0].tets)
    for other in solids[1:]:
        assert np.array_equal(other.tets, solids[0].tets)
        assert np.abs(other.vertices - solids[0].vertices).max() < 1e-6


def test_a_block_comes_out_exactly_with_a_flat_base(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.06))
    box.apply_translation((1000.0, -500.0, 20.0))  # far from the origin, as in a surveyor's coordinates
    path = tmp_path / "box.obj"
    path.write_text("".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in box.vertices)
                    + "".join(f"f {a} {b} {c}\n" for a, b, c in box.faces + 1))
    solid = fill_mesh_file(MeshFile(str(path), 1.0), resolution=0.012)
    assert solid.volume() == pytest.approx(6e-4, rel=1e-6)
    assert np.ptp(solid.vertices, axis=0) == pytest.approx([0.1, 0.1, 0.06], abs=1e-7)
    base = solid.vertices[solid.vertices[:, 2] < 1e-6]
    assert np.ptp(base[:, :2], axis=0) == pytest.approx([0.1, 0.1], abs=1e-7)


def test_up(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    box.visual.vertex_colors = np.tile([[255, 0, 0, 255]], (8, 1))  # not used
    box.export(tmp_path / "b.ply")
    solid = fill_mesh_file(MeshFile(str(tmp_path / "b.ply"), 1.0, "y"), resolution=0.01)
    assert np.ptp(solid.vertices, axis=0) == pytest.approx([0.1, 0.04, 0.06], abs=1e-6)


def test_double_sided_and_touching_parts(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.1, 0.06))
    both = trimesh.Trimesh(box.vertices, np.concatenate([box.faces, box.faces[:, ::-1]]), process=False)
    other = box.copy()
    other.apply_translation((0.1, 0.0, 0.0))
    for mesh, size in ((both, 6e-4), (trimesh.util.concatenate([box, other]), 12e-4)):
        mesh.export(tmp_path / "b.ply")
        assert fill_mesh_file(MeshFile(str(tmp_path / "b.ply")), resolution=0.015,
                              ).volume() == pytest.approx(size, rel=0.01)
