"""Broken scans: what is repaired and said, and what is refused and why."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from vsfsim.core.errors import MeshError, SceneError
from vsfsim.core.shape import MeshFile
from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.physics.mesh import scan
from vsfsim.physics.mesh.scan import fill_mesh_file
from vsfsim.physics.mesh.validity import pinched_vertices

SIZE = 0.03
VOLUME = float(trimesh.creation.icosphere(subdivisions=2, radius=SIZE).volume)


def ball(*, shift: tuple[float, float, float] = (0.1, -0.2, 0.3), radius: float = SIZE) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation(shift)
    return mesh


def hollow(wall: float) -> trimesh.Trimesh:
    inner = ball(radius=SIZE - wall)
    inner.invert()
    return trimesh.util.concatenate([ball(), inner])


def filled(mesh: trimesh.Trimesh, folder: Path, *, name: str = "scan.ply") -> Solid:
    mesh.export(folder / name)
    return fill_mesh_file(MeshFile(str(folder / name)), resolution=0.02)


def check_filled(solid: Solid, volume: float, *, within: float) -> None:
    assert tet_volumes(solid.vertices, solid.tets).min() > 0.0
    assert solid.volume() == pytest.approx(volume, rel=within)
    faces, _ = solid.surface()
    surface = trimesh.Trimesh(solid.vertices, faces, process=False)
    assert surface.is_watertight and surface.is_winding_consistent and surface.volume > 0.0
    assert not len(pinched_vertices(solid.tets))
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    assert [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]] == pytest.approx([0, 0, 0], abs=1e-12)


def test_sound_mesh_needs_no_repair(tmp_path: Path) -> None:
    solid = filled(ball(), tmp_path)
    check_filled(solid, VOLUME, within=0.02)
    assert [note.split()[0] for note in solid.notes] == ["Elements", "Filling", "Moved"], solid.notes


def test_hole(tmp_path: Path) -> None:
    mesh = ball()
    mesh.update_faces(np.arange(len(mesh.faces)) >= 6)
    solid = filled(mesh, tmp_path)
    check_filled(solid, VOLUME, within=0.05)
    assert any("Not watertight" in note for note in solid.notes)


def test_debris_is_dropped_and_two_objects_refused(tmp_path: Path) -> None:
    crumb = ball(shift=(0.2, -0.2, 0.3), radius=0.2 * SIZE)
    solid = filled(trimesh.util.concatenate([ball(), crumb]), tmp_path)
    check_filled(solid, VOLUME, within=0.02)
    assert any("loose piece" in note for note in solid.notes)
    with pytest.raises(MeshError, match="2 separate bodies"):
        filled(trimesh.util.concatenate([ball(), ball(shift=(0.3, 0.0, 0.0))]), tmp_path, name="two.ply")


def test_refusals_give_the_reason(tmp_path: Path) -> None:
    def refused(content: bytes | trimesh.Trimesh, name: str, reason: str, scale: float | None = None) -> None:
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            content.export(path)
        with pytest.raises(MeshError, match=reason) as caught:
            fill_mesh_file(MeshFile(str(path), scale), resolution=0.02)
        assert name in str(caught.value) and "\n" not in str(caught.value)

    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0.1], [0.1, 0.1, 0.1], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]])
    refused(sheet, "sheet.ply", "flat sheet")
    refused(b"", "empty.obj", "no faces|cannot be understood")
    refused(b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "points.obj", "no faces")
    refused(b"v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n", "nan.obj", "not finite")
    refused(b"\x00\x01nonsense", "noise.ply", "cannot be understood")
    refused(b"solid x", "scan.fbx", "ends in '.fbx'")
    refused(ball(radius=1e-4, shift=(0, 0, 0)), "tiny.ply", "0.0002 m long")
    refused(ball(radius=1.0), "huge.ply", "allowed is", scale=10.0)
    with pytest.raises(MeshError, match="cannot be read"):
        fill_mesh_file(MeshFile(str(tmp_path / "missing.stl")), resolution=0.02)
    with pytest.raises(SceneError, match="coarser resolution"):
        ball().export(tmp_path / "fine.ply")
        fill_mesh_file(MeshFile(str(tmp_path / "fine.ply")), resolution=1e-5)


def test_everything_wrong_at_once(tmp_path: Path) -> None:
    """Millimetres, a hole, mixed winding, an inside-out lobe through the body, duplicate and degenerate faces, a loose
    crumb."""
    body, lobe = ball(shift=(0, 0, 0)), ball(shift=(0, 0, 0.8 * SIZE), radius=0.6 * SIZE)
    body.faces[::7] = body.faces[::7, ::-1]
    lobe.invert()
    mesh = trimesh.util.concatenate([body, lobe, ball(shift=(0.1, 0, 0), radius=0.1 * SIZE)])
    mesh = trimesh.Trimesh(1000.0 * mesh.vertices, np.concatenate([mesh.faces[6:], mesh.faces[50:53], [[0, 0, 1]]]),
                           process=False)
    solid = filled(mesh, tmp_path)
    # two balls of radii R and 0.6 R, their centres 0.8 R apart: the lens that counts once, in closed form
    d, r = 0.8, 0.6
    lens = np.pi * (1 + r - d) ** 2 * (d * d + 2 * d * r - 3 * r * r + 2 * d + 6 * r - 3) / (12 * d)
    union = VOLUME * (1 + r**3 - lens / (4 / 3 * np.pi))
    check_filled(solid, union, within=0.05)
    for said in ("3 duplicate", "1 degenerate", "millimetres", "inconsistently", "faces were inside out",
                 "Not watertight", "Dropped 1 loose"):
        assert any(said in note for note in solid.notes), (said, solid.notes)


def test_a_filling_of_another_size_is_refused_with_its_account(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A filler that loses a tenth of the length: the volume goes with it."""
    ball().export(tmp_path / "scan.ply")
    fill = scan.fill_lattice

    def shrunk(*given: object) -> tuple[np.ndarray, np.ndarray]:
        vertices, tets = fill(*given)
        return 0.95 * vertices, tets

    def broken(*given: object) -> None:
        raise MeshError("out of luck")

    monkeypatch.setattr(scan, "ftetwild", broken)
    monkeypatch.setattr(scan, "fill_lattice", shrunk)
    monkeypatch.setattr(scan, "pull_to_features", lambda vertices, *more: vertices)
    with pytest.raises(MeshError, match=r"within 10 % of the scan.*volume .* \(-1\d.*%\).*finer resolution"):
        fill_mesh_file(MeshFile(str(tmp_path / "scan.ply")), resolution=0.02)


@pytest.mark.parametrize(("filler", "words"), [
    ("raise RuntimeError('out of luck')", "out of luck"),
    ("import resource\nresource.setrlimit(resource.RLIMIT_CPU, (1, 1))\nwhile True: pass", "60 s of processor time")])
def test_a_filler_that_dies_or_does_not_end_is_an_error(
        filler: str, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(scan, "_FILLER", filler)
    with pytest.raises(MeshError, match=f"x.stl.*{words}"):
        scan.ftetwild(SimpleNamespace(vertices=np.zeros((3, 3)), faces=np.zeros((1, 3)), extents=np.ones(3)), 0.01,
                      Path("x.stl"))
    assert not list(tmp_path.rglob("*.npz"))


@pytest.mark.slow
def test_walls_thinner_than_any_lattice_are_filled_by_ftetwild_once(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    solid = filled(hollow(0.0008), tmp_path)
    check_filled(solid, float(hollow(0.0008).volume), within=0.05)
    assert any("fTetWild" in note for note in solid.notes)
    monkeypatch.setattr(scan, "_FILLER", "raise RuntimeError('made again')")
    scan._filled.cache_clear()
    assert np.array_equal(filled(hollow(0.0008), tmp_path).vertices, solid.vertices)


@pytest.mark.slow
def test_thin_walls_survive_a_coarse_fill(tmp_path: Path) -> None:
    """A hollow ball with walls of 3 mm, elements of 20 mm."""
    mesh = hollow(0.003)
    check_filled(filled(mesh, tmp_path), float(mesh.volume), within=0.05)
