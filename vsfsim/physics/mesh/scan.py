"""A user's own surface mesh, checked, repaired and filled with tetrahedra.

The filler is fTetWild through pytetwild (Hu et al. 2020). It accepts holes and self-intersections, and fills the region
that the generalised winding number classifies as inside. Its output differs from run to run, even with one thread, so
the first result is stored under a hash of the input and every later build reads it. A lock lets one worker fill a mesh
while the others wait.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import MeshFile
from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.physics import disk_cache
from vsfsim.physics.mesh.manifold import body_of_each_tet, drop_pinches
from vsfsim.physics.mesh.winding import winding_number

FORMATS = (".obj", ".ply", ".stl")
"""File formats that are read."""
LARGEST = 5.0
"""Largest allowed edge of the bounding box [m]. Nothing that a robot arm touches is larger, so a file with a bounding
box of more units is read as millimetres."""
SMALLEST = 0.002
"""Smallest allowed length of the longest edge of the bounding box [m]."""
DEBRIS = 0.05
"""Fraction of the largest body's volume up to which another body is scanner debris; a larger one is a second object."""
MAX_TETS = 2_000_000
"""Largest estimated number of tetrahedra in the bounding box."""
_RECIPE = 2
"""Part of the cache key, to be raised when the repairs or the filling change."""
_ENVELOPES = (1 / 20, 1 / 100)
"""Distances that the surface may move, in units of the element size; the second is tried if the first changes the
volume by more than `_VOLUME`. fTetWild's default is 0.1 % of the diagonal, 1/67 of an element of 12 mm in a hand-sized
scan. With it a bumpy surface is cut into three times the requested number of tetrahedra; 1/20 costs half a per cent of
the volume."""
_VOLUME = 0.02
"""Relative difference between filled volume and surface's volume above which a wall was thinner than the envelope."""


def fill_mesh_file(shape: MeshFile, *, resolution: float, cache: Path | None = None) -> Solid:
    """Read, repair and fill a surface mesh; ``notes`` has one sentence per repair.

    Args:
        shape: file and scale (None: metres or millimetres, by the size).
        resolution: target edge length of the tetrahedra [m].
        cache: folder for filled meshes; None is ``$XDG_CACHE_HOME/vsfsim`` or ``~/.cache/vsfsim``.

    Returns:
        A solid with one region "body"; its lowest z is 0, and its bounding box is centred in x and y.

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces, is not finite, is flat, is too large or too small,
            holds several objects, or cannot be filled.
    """
    path = Path(shape.path)
    content = _content(path)
    key = hashlib.sha256(content + repr((path.suffix.lower(), shape.scale, resolution, _RECIPE,
                                         importlib.metadata.version("pytetwild"))).encode()).hexdigest()
    folder = disk_cache.folder() if cache is None else Path(cache)
    stored = folder / f"tets-{key[:32]}.npz"
    with disk_cache.locked(stored):
        found = _read(stored)
        if found is None:
            surface, notes = read_surface(shape)
            vertices, tets, more = fill(surface, resolution, path)
            _write(stored, vertices, tets, notes + more)
            # On a file system without locks another worker may have been first; every worker then uses its file.
            found = _read(stored) or (vertices, tets, notes + more)
    vertices, tets, notes = found
    return Solid(vertices, tets, np.zeros(len(tets), np.int64), ("body",), notes=tuple(notes))


def read_surface(shape: MeshFile) -> tuple[trimesh.Trimesh, list[str]]:
    """The surface in metres, wound outwards where an outside exists, and one sentence per repair.

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces, is not finite, is flat, or is too large or too
            small.
    """
    path, notes = Path(shape.path), []
    mesh = _load(path)
    if not np.isfinite(mesh.vertices).all():
        raise _not_finite(path, mesh.vertices)
    before = len(mesh.faces)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    degenerate = before - len(mesh.faces)
    mesh.update_faces(mesh.unique_faces())
    duplicate = before - degenerate - len(mesh.faces)
    mesh.remove_unreferenced_vertices()
    if degenerate:
        notes.append(f"Removed {degenerate} degenerate faces.")
    if duplicate:
        notes.append(f"Removed {duplicate} duplicate faces.")
    if not len(mesh.faces):
        raise MeshError(f"mesh file '{path}' has no faces with an area (of {before} given); a closed triangle "
                        "surface is needed.")

    extent = float(mesh.extents.max())
    scale = _metres_per_unit(shape, extent)
    if shape.scale is None:
        if scale != 1.0:
            notes.append(f"The bounding box is {extent:.4g} units long, more than {LARGEST:g}, so the file was read as "
                         f"millimetres; give scale (metres per unit) to say otherwise.")
    else:
        notes.append(f"Scaled by {scale:g} metres per unit, as given.")
    mesh.apply_scale(scale)
    extent *= scale
    if not SMALLEST <= extent <= LARGEST:
        raise MeshError(f"mesh file '{path}': its bounding box is {extent:.4g} m long after a scale of {scale:g}; "
                        f"allowed is {SMALLEST:g} to {LARGEST:g} m. Give the right scale (metres per unit), e.g. "
                        f"{{ mesh = \"{path.name}\", scale = 0.01 }} for centimetres.")
    if mesh.extents.min() < 1e-4 * extent or _is_planar(mesh.vertices):
        raise MeshError(f"mesh file '{path}' is a flat sheet ({' x '.join(f'{e:.4g}' for e in mesh.extents)} m) and "
                        "encloses no volume; give it thickness, e.g. with a solidify modifier.")

    if not mesh.is_winding_consistent:
        given = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        turned = int((mesh.faces != given).any(axis=1).sum())
        notes.append(f"Faces were wound inconsistently; turned {turned} of {len(given)} to agree with their "
                     "neighbours.")
    inside_out = 0
    for faces in trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)), min_len=1):
        if _signed_volume(mesh.vertices, mesh.faces[faces]) < 0.0 and not _is_cavity(mesh, faces):
            mesh.faces[faces] = mesh.faces[faces][:, ::-1]
            inside_out += len(faces)
    if inside_out:
        notes.append(f"{inside_out} of {len(mesh.faces)} faces were inside out; turned them round.")
    if not mesh.is_watertight:
        _, count = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
        notes.append(f"Not watertight: {int((count == 1).sum())} open edges and {int((count > 2).sum())} edges with "
                     "more than two faces; closed by the filler.")
    return mesh, notes


def extents(shape: MeshFile) -> np.ndarray:
    """Edges of the file's bounding box (3,) [m].

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces or is not finite.
    """
    path = Path(shape.path)
    stamp = path.stat().st_mtime_ns if path.is_file() else None
    return _extents(shape, stamp).copy()


@functools.lru_cache(maxsize=16)
def _extents(shape: MeshFile, stamp: int | None) -> np.ndarray:
    # ``stamp``, the file's modification time, is part of the key so that an edited file is read again.
    _content(Path(shape.path))
    mesh = _load(Path(shape.path))
    used = mesh.vertices[np.unique(mesh.faces)]
    if not np.isfinite(used).all():
        raise _not_finite(Path(shape.path), mesh.vertices)
    size = np.ptp(used, axis=0)
    return size * _metres_per_unit(shape, float(size.max()))


def fill(surface: trimesh.Trimesh, resolution: float, path: Path) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Vertices (n, 3) [m] and tetrahedra (m, 4) inside a surface, with the base centre at the origin, and notes.

    Raises:
        MeshError: the mesh would have too many tetrahedra, encloses no volume, or holds more than one object.
    """
    notes = []
    # A volume h^3 holds about 8.5 regular tetrahedra of edge h, and a body fills about a third of its bounding box.
    cells = 3.0 * float(np.prod(surface.extents)) / resolution**3
    if cells > MAX_TETS:
        raise MeshError(f"mesh file '{path}': resolution {resolution:g} m would cut its bounding box of "
                        f"{' x '.join(f'{e:.3g}' for e in surface.extents)} m into about {cells:.1e} tetrahedra; use a "
                        "coarser resolution, and check the scale.")
    for envelope in _ENVELOPES:
        vertices, tets = _run_filler(surface, resolution,
                                     envelope * resolution / float(np.linalg.norm(surface.extents)), path)
        filled = np.abs(tet_volumes(vertices, tets)).sum()
        if not surface.is_watertight or abs(filled / surface.volume - 1.0) <= _VOLUME:
            break
    volumes = tet_volumes(vertices, tets) if len(tets) else np.zeros(0)
    tets[volumes < 0.0] = tets[volumes < 0.0][:, [1, 0, 2, 3]]
    volumes = np.abs(volumes)
    if volumes.sum() < 1e-4 * float(np.prod(surface.extents)):
        raise MeshError(f"mesh file '{path}' encloses no volume: {volumes.sum():.3g} m^3 of a bounding box of "
                        f"{float(np.prod(surface.extents)):.3g} m^3. It is an open sheet; close it or give "
                        "it thickness.")
    flat = volumes <= 1e-9 * resolution**3
    tets = tets[~flat]
    body = body_of_each_tet(tets)
    sizes = np.bincount(body, weights=volumes[~flat])
    if (sizes > DEBRIS * sizes.max()).sum() > 1:
        listing = ", ".join(f"{1e6 * v:.3g}" for v in np.sort(sizes)[::-1][:5])
        raise MeshError(f"mesh file '{path}' holds {int((sizes > DEBRIS * sizes.max()).sum())} separate bodies "
                        f"(volumes {listing} cm^3); an object is one body. Keep one, or join them.")
    if len(sizes) > 1:
        notes.append(f"Dropped {len(sizes) - 1} loose pieces, {100 * (1 - sizes.max() / sizes.sum()):.2g} % of "
                     "the volume.")
        tets = tets[body == sizes.argmax()]
    kept = drop_pinches(vertices, tets)
    if kept is None:
        raise MeshError(f"mesh file '{path}': its surface touches itself in so many places at resolution "
                        f"{resolution:g} m that no clean boundary is left; use a finer resolution.")
    if len(kept) < len(tets):
        notes.append(f"Removed {len(tets) - len(kept)} tetrahedra where the surface touched itself at a point "
                     "or an edge.")
    used, tets = np.unique(kept, return_inverse=True)
    vertices, tets = vertices[used], tets.reshape(-1, 4)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    notes.append(f"Moved by ({', '.join(f'{-s:.4g}' for s in shift)}) m so that the base centre is the origin.")
    if surface.is_watertight and abs(tet_volumes(vertices, tets).sum() / surface.volume - 1.0) > _VOLUME:
        notes.append(f"The filled volume is {100 * tet_volumes(vertices, tets).sum() / surface.volume:.3g} % of the "
                     "surface's; overlapping parts count once, and detail finer than the resolution is lost.")
    return vertices - shift, tets, notes


# fTetWild runs in a process and a folder of its own: it leaves "__tracked_surface.stl" in the working directory, and
# may crash on a mesh that it cannot fill.
# fTetWild's package imports PyVista, which takes most of such a process, only to add a function to its meshes; a module
# without functions is to it a PyVista that is too old for that.
_FILLER = """
import sys
import types
import numpy as np
sys.modules["pyvista"] = types.ModuleType("pyvista")
import pytetwild
given = np.load(sys.argv[1])
vertices, tets = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(given["resolution"]),
                                          epsilon=float(given["envelope"]), num_threads=1, quiet=True)
np.savez(sys.argv[2], vertices=vertices, tets=tets)
"""
_TIME_LIMIT = 1800.0
"""Time after which the filler is stopped [s]; a fine mesh of a detailed scan takes minutes."""


def _run_filler(surface: trimesh.Trimesh, resolution: float, envelope: float,
                path: Path) -> tuple[np.ndarray, np.ndarray]:
    with tempfile.TemporaryDirectory(prefix="vsfsim-fill-") as folder:
        given, made = Path(folder, "given.npz"), Path(folder, "made.npz")
        np.savez(given, vertices=np.asarray(surface.vertices, np.float64), faces=np.asarray(surface.faces, np.int32),
                 resolution=resolution, envelope=envelope)
        try:
            done = subprocess.run([sys.executable, "-c", _FILLER, str(given), str(made)], cwd=folder, check=False,
                                  capture_output=True, text=True, timeout=_TIME_LIMIT)
            reason = (done.stderr.strip().splitlines() or [f"it ended with status {done.returncode}"])[-1]
        except subprocess.TimeoutExpired:
            reason = f"it took more than {_TIME_LIMIT / 60:g} minutes"
        if not made.exists():
            raise MeshError(f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m: {reason}. "
                            "Use a coarser resolution, or repair the mesh by hand (e.g. in MeshLab).")
        with np.load(made, allow_pickle=False) as data:
            return data["vertices"].astype(np.float64), data["tets"].astype(np.int64)


def _content(path: Path) -> bytes:
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"mesh file '{path}' ends in '{path.suffix}'; allowed are {', '.join(FORMATS)}. Convert it, "
                        "e.g. with MeshLab.")
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"mesh file '{path}' cannot be read: {error.strerror}. Give the path of an OBJ, PLY "
                        "or STL file, relative to the scene file.") from error


def _metres_per_unit(shape: MeshFile, longest: float) -> float:
    if shape.scale is not None:
        return shape.scale
    return 1e-3 if longest > LARGEST else 1.0


def _not_finite(path: Path, vertices: np.ndarray) -> MeshError:
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    return MeshError(f"mesh file '{path}': {bad} of {len(vertices)} vertices are not finite numbers (NaN or infinite); "
                     "export the mesh again.")


def _load(path: Path) -> trimesh.Trimesh:
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # a parser may fail in any way on a damaged file
        raise MeshError(f"mesh file '{path}' cannot be understood as {path.suffix[1:].upper()}: "
                        f"{type(error).__name__}: {error}. Export it again.") from error
    if not isinstance(mesh, trimesh.Trimesh) or mesh.vertices is None or not len(mesh.faces):
        raise MeshError(f"mesh file '{path}' has no faces; a closed triangle surface is needed (a point cloud is "
                        "not enough).")
    return trimesh.Trimesh(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64), process=False)


def _is_planar(vertices: np.ndarray) -> bool:
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    return bool(spread[2] < 1e-4 * spread[0])


def _signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    # The volume is taken about the part's centre, so that the result for an open part does not depend on its position.
    a, b, c = (vertices[faces[:, n]] - vertices[np.unique(faces)].mean(axis=0) for n in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def _is_cavity(mesh: trimesh.Trimesh, faces: np.ndarray) -> bool:
    """Whether a part that is wound inwards lies inside the other parts, and thus is a cavity of a hollow body."""
    others = np.setdiff1d(np.arange(len(mesh.faces)), faces)
    if not len(others):
        return False
    spot = mesh.vertices[mesh.faces[faces[0], 0]][None]
    return bool(abs(winding_number(mesh.vertices, mesh.faces[others], spot)[0]) > 0.5)


# ---------------------------------------------------------------------------------------------- the cache


def _read(path: Path) -> tuple[np.ndarray, np.ndarray, list[str]] | None:
    found = disk_cache.read(path)
    if found is None or not {"vertices", "tets", "notes"} <= set(found):
        return None
    return found["vertices"], found["tets"], [str(note) for note in found["notes"]]


def _write(path: Path, vertices: np.ndarray, tets: np.ndarray, notes: list[str]) -> None:
    disk_cache.write(path, vertices=vertices, tets=tets, notes=np.array(notes, dtype=np.str_))
