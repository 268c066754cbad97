"""A user's own surface mesh, checked, repaired and filled with tetrahedra: the same body from the same surface.

`repair` reads the surface, `lattice` fills it, `account` compares the two. Where a wall is thinner than the lattice
resolves, finer ones are tried, and where none of them is near the surface, fTetWild (`ftetwild`) fills it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from filelock import FileLock

from vsfsim.core.errors import MeshError
from vsfsim.core.extras import require
from vsfsim.core.shape import MeshFile
from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.physics.mesh.account import BASE, TOLD, Account, account, level, refuse, scan_volume
from vsfsim.physics.mesh.lattice import CELL, DENSITY, fill_lattice, pull_to_features
from vsfsim.physics.mesh.repair import DEBRIS, Surface, read_surface
from vsfsim.physics.mesh.structured import check_cells
from vsfsim.physics.mesh.surface_distance import nearest_on
from vsfsim.physics.mesh.validity import body_of_each_tet, drop_pinches

_FINER = tuple(0.5 ** (k / 2) for k in range(9))
"""Sizes of lattices that are tried, over the size asked for; the first is kept whose box and volume are within 2 %."""
_ENOUGH = 0.05  # difference up to which a lattice is preferred to fTetWild, whose mesh differs from run to run [-]
_ENVELOPE = 1 / 100  # distance that fTetWild may move the surface, in units of the element size [-]
_MOST_TETS = 60_000  # tetrahedra of a lattice that is finer than asked for, at most
_SHARP = np.radians(35.0)  # between the normals of two faces whose common edge the filling shall keep
_DIGITS = 5  # of a coordinate over the longest edge of the box; a binary STL file has seven
_TURN = np.cos(np.radians(35.0))  # between two sharp edges whose common end is a corner
# fTetWild runs in a process and a folder of its own: it leaves "__tracked_surface.stl" in the working directory, and
# may crash on a mesh that it cannot fill. Its package imports PyVista, which takes most of such a process, only to add
# a function to its meshes; a module without functions is to it a PyVista that is too old for that.
_FILLER = """
import resource, sys, types
import numpy as np
given = np.load(sys.argv[1])
resource.setrlimit(resource.RLIMIT_CPU, (int(given["seconds"]),) * 2)
sys.modules["pyvista"] = types.ModuleType("pyvista")
import pytetwild
vertices, tets = pytetwild.tetrahedralize(given["vertices"], given["faces"], edge_length_abs=float(given["resolution"]),
                                          epsilon=float(given["envelope"]), num_threads=1, quiet=True)
np.savez(sys.argv[2], vertices=vertices, tets=tets)
"""
CPU_LIMIT = 60
"""Processor time after which the filler is stopped [s]; the load of the machine has no say."""


class _Filling(NamedTuple):
    vertices: np.ndarray
    tets: np.ndarray
    account: Account
    notes: list[str]


def fill_mesh_file(shape: MeshFile, *, resolution: float) -> Solid:
    """Read, repair and fill a surface mesh, once in a process; ``notes`` has one sentence per repair, and the account
    of the filling.

    Args:
        shape: file and scale (None: metres or millimetres, by the size).
        resolution: target edge length of the tetrahedra [m].

    Returns:
        A solid with one region "body"; its lowest z is 0, and its bounding box is centred in x and y.

    Raises:
        SceneError: the mesh would have too many cells.
        MeshError: the file is unreadable, or the mesh has no faces, is not finite, is flat, is too large or too small,
            encloses no volume, holds several objects, cannot be filled, or the filling is off by more than 10 % of it.
    """
    return _filled(shape, resolution, shape.content())


@functools.lru_cache(maxsize=4)
def _filled(shape: MeshFile, resolution: float, content: bytes) -> Solid:
    surface, path = read_surface(shape), Path(shape.path)
    check_cells(surface.extents, resolution, f"mesh file '{path}'")
    volume = scan_volume(surface)
    if volume < 1e-4 * float(np.prod(surface.extents)):
        raise MeshError(f"mesh file '{path}' encloses no volume: {volume:.3g} m^3 of a bounding box of "
                        f"{float(np.prod(surface.extents)):.3g} m^3. It is an open sheet; close it or give "
                        "it thickness.")
    vertices, tets, found, notes = _best(surface, volume, resolution, path)
    refuse(found, f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m",
           "Use a finer resolution ([object] resolution), or repair the mesh by hand")
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    moved = -(surface.centre + shift)
    notes += [found.sentence(), f"Moved by ({', '.join(f'{s:.4g}' for s in moved)}) m so that the base centre is the "
              "origin."]
    return Solid(vertices - shift, tets, np.zeros(len(tets), np.int64), ("body",), notes=(*surface.notes, *notes),
                 nearest=functools.partial(nearest_on, surface.vertices - shift, surface.faces))


forget_fillings = _filled.cache_clear
"""Fill a scan anew in this process."""


def _best(surface: Surface, volume: float, resolution: float, path: Path) -> _Filling:
    """The coarsest lattice that is within 2 % of the surface, or else what comes closest."""
    within, (low, high) = level(surface), (surface.vertices.min(axis=0), surface.vertices.max(axis=0))
    corners, edges = features(surface)
    tried: list[_Filling] = []
    problem = None
    for part in _FINER:
        size = part * resolution
        if part < 1.0 and DENSITY * volume / size**3 > _MOST_TETS:
            break
        vertices, tets = fill_lattice(within, low, high, size)
        if not len(tets):
            continue
        note = (f"Elements are {1e3 * size:.3g} mm instead of {1e3 * resolution:.3g} mm, so that the filling keeps the "
                f"scan's volume and box.")
        try:
            tried.append(_filling(surface, volume, pull_to_features(vertices, tets, corners, edges, CELL * size), tets,
                                  [note] * (part < 1.0), resolution, path))
        except MeshError as error:
            if surface.parts > 1 and not surface.overlap:
                raise  # of separate bodies
            problem = problem or error
            continue
        if _misses(tried[-1]) <= TOLD:
            return tried[-1]
    if not tried or min(map(_misses, tried)) > _ENOUGH:
        try:
            tried.append(_filling(surface, volume, *ftetwild(surface, resolution, path), [
                "Filled by fTetWild, because parts are thinner than a lattice of this resolution holds; its mesh "
                "differs from run to run, and the first one is kept."], resolution, path))
        except MeshError as error:
            if not tried:
                raise problem or error from error
    return min(tried, key=_misses)


def ftetwild(surface: Surface, resolution: float, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and positively oriented tetrahedra (m, 4) inside a surface, by fTetWild (Hu et al. 2020)
    through pytetwild, which takes a surface that crosses itself, and walls of any thickness.

    Its mesh differs from run to run, even with one thread: it is asked for where a regular lattice does not do, and
    what it made first is kept on disk, in ``$XDG_CACHE_HOME/vsfsim`` or ``~/.cache/vsfsim``.

    Args:
        surface: what is filled.
        resolution: edge length [m].
        path: of the mesh file, for messages.

    Raises:
        MissingPackage: pytetwild is not installed.
        MeshError: the filler failed, or took more processor time than `CPU_LIMIT`.
    """
    given = {"vertices": np.asarray(surface.vertices, np.float64), "faces": np.asarray(surface.faces, np.int32),
             "resolution": np.float64(resolution), "seconds": np.int64(CPU_LIMIT),
             "envelope": np.float64(_ENVELOPE * resolution / np.linalg.norm(surface.extents))}
    key = hashlib.sha256(b"".join(value.tobytes() for value in given.values())).hexdigest()

    def make() -> dict[str, np.ndarray]:
        require("sim", "pytetwild")
        print(f"{path.name}: fTetWild fills it, in at most {CPU_LIMIT} s of processor time", file=sys.stderr)
        with tempfile.TemporaryDirectory(prefix="vsfsim-fill-") as folder:
            np.savez(Path(folder, "given.npz"), **given)  # type: ignore[arg-type]
            filler = subprocess.run([sys.executable, "-c", _FILLER, "given.npz", "made.npz"], cwd=folder, text=True,
                                    stdout=subprocess.PIPE, stderr=subprocess.STDOUT, errors="replace")
            made = Path(folder, "made.npz")
            if filler.returncode != 0 or not made.exists():
                said = filler.stdout.strip().splitlines() or [f"it was stopped with status {filler.returncode}, as it "
                                                              f"is after {CPU_LIMIT} s of processor time"]
                raise MeshError(f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m: "
                                f"{said[-1]}. Use a coarser resolution, or repair the mesh by hand (e.g. in MeshLab).")
            with np.load(made, allow_pickle=False) as data:
                return {name: data[name] for name in data.files}

    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    found = _kept(base / "vsfsim" / f"tets-{key[:32]}.npz", make)
    vertices, tets = found["vertices"].astype(np.float64), found["tets"].astype(np.int64)
    volumes = tet_volumes(vertices, tets)
    tets[volumes < 0.0] = tets[volumes < 0.0][:, [1, 0, 2, 3]]
    return vertices, tets[np.abs(volumes) > 1e-9 * resolution**3]


def _kept(path: Path, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a file, or else those that ``make`` gives, which are kept there, whole or not at all: made by one
    worker while the others wait. A folder that cannot be written, or a file system without locks, costs double work."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(path.with_suffix(".lock")))
        made: dict[str, np.ndarray] = {}
        for _ in range(2):
            with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as data:  # none, or a damaged one
                return dict(data)
            made = made or make()
            with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part") as file:
                np.savez(file, **made)  # type: ignore[arg-type]
                file.flush()
                os.link(file.name, path)  # not where another worker was first, without locks: its file is read then
        return made


def _misses(filling: _Filling) -> float:
    """What a finer lattice is tried for; corners that are cut by a part of an element are told, and no reason."""
    off = filling.account.off
    return max(abs(off["volume"]), off["box"])


def _filling(surface: Surface, volume: float, vertices: np.ndarray, tets: np.ndarray, notes: list[str],
             resolution: float, path: Path) -> _Filling:
    """The largest body, with a clean boundary, and its account.

    Raises:
        MeshError: there are several bodies, or the boundary touches itself.
    """
    body = body_of_each_tet(tets)
    sizes = np.bincount(body, weights=tet_volumes(vertices, tets))
    large = np.sort(sizes[sizes > DEBRIS * sizes.max()])[::-1]
    if len(large) > 1:
        raise MeshError(f"mesh file '{path}' holds {len(large)} separate bodies (volumes "
                        f"{', '.join(f'{1e6 * v:.3g}' for v in large[:5])} cm^3); an object is one body. Keep one, or "
                        f"join them.")
    if len(sizes) > 1:
        notes = [*notes, f"Dropped {len(sizes) - 1} loose pieces, {100 * (1 - sizes.max() / sizes.sum()):.2g} % of the "
                 f"volume."]
        tets = tets[body == sizes.argmax()]
    kept = drop_pinches(vertices, tets)
    if kept is None:
        raise MeshError(f"mesh file '{path}': its surface touches itself in so many places at resolution "
                        f"{resolution:g} m that no clean boundary is left; use a finer resolution.")
    if len(kept) < len(tets):
        notes = [*notes, f"Removed {len(tets) - len(kept)} tetrahedra where the surface touched itself at a point or "
                 f"an edge."]
    used, tets = np.unique(kept, return_inverse=True)
    vertices, tets = vertices[used], tets.reshape(-1, 4)
    return _Filling(vertices, tets, account(surface, volume, vertices, tets), notes)


def features(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """What a filling shall keep: corners and extreme points (k, 3), and ends of sharp edges (e, 2, 3) [m]."""
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    sharp = np.asarray(mesh.face_adjacency_edges)[np.asarray(mesh.face_adjacency_angles) > _SHARP]
    v = surface.vertices.copy()
    base = float(v[:, 2].min())
    v[v[:, 2] < base + BASE * surface.extents[2], 2] = base  # the base is cut flat
    ends: dict[int, list[np.ndarray]] = {}
    for a, b in sharp.tolist():
        along = (v[b] - v[a]) / max(float(np.linalg.norm(v[b] - v[a])), 1e-300)
        ends.setdefault(a, []).append(along)
        ends.setdefault(b, []).append(-along)
    corners = [n for n, ways in sorted(ends.items()) if len(ways) != 2 or -float(ways[0] @ ways[1]) < _TURN]
    # ties and the order do not hang on the rounding of a file format
    rough = np.round(v / float(surface.extents.max()), _DIGITS)
    order = np.lexsort(rough.T)
    highest = [int(order[pick(rough[order, axis])]) for pick, axes in ((np.argmax, range(3)), (np.argmin, range(2)))
               for axis in axes]
    wanted = np.isin(order, [*highest, *corners])
    return v[order[wanted]], v[sharp]
