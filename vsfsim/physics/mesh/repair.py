"""A user's surface mesh, in metres about the centre of its box, with every part wound by its nesting.

One reader for objects and probes. Corners that lie on each other are joined, faces given twice or without an area are
left out, holes are closed by a fan about the middle of their rim. A part inside another is a cavity, whatever way it is
wound; a part inside a cavity is solid again.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import MeshFile
from vsfsim.physics.mesh.formats import FORMATS, Facets, parse
from vsfsim.physics.mesh.surface_distance import winding_number
from vsfsim.physics.mesh.validity import joined

LARGEST = 5.0
"""Largest allowed edge of the bounding box [m]. Nothing that a robot arm touches is larger, so a file with a bounding
box of more units is read as millimetres."""
SMALLEST = 0.002
"""Smallest allowed length of the longest edge of the bounding box [m]."""
DEBRIS = 0.05
"""Fraction of the largest part's volume up to which a loose part is scanner debris; a larger one is a second object."""
_WELD = 1e-6  # distance of corners that are joined, over the longest edge of the bounding box
_UP = {"x": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]], float),
       "y": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], float), "z": np.eye(3)}


@dataclass(frozen=True)
class Surface:
    """A surface that bounds a body."""

    vertices: np.ndarray
    """Corners about the centre of the bounding box (n, 3) [m]."""
    faces: np.ndarray
    """Triangles (f, 3), wound outwards: away from the solid."""
    centre: np.ndarray
    """Of the bounding box, in the file's frame, upright (3,) [m]."""
    cavities: int
    """Parts that bound a cavity."""
    parts: int
    """Parts that bound a solid."""
    watertight: bool
    """Whether every edge has two faces, wound alike."""
    overlap: bool
    """Whether parts may overlap: their boxes do, and neither lies in the other."""
    colour: np.ndarray | None
    """Mean colour, sRGB in 0..1 (3,), or None."""
    notes: tuple[str, ...]
    """One sentence per repair."""

    @property
    def extents(self) -> np.ndarray:
        """Edges of the bounding box (3,) [m]."""
        return np.ptp(self.vertices, axis=0)


def content(shape: MeshFile) -> bytes:
    """The bytes of a mesh file.

    Raises:
        MeshError: the ending is not of `FORMATS`, or the file cannot be read.
    """
    path = Path(shape.path)
    if path.suffix.lower() not in FORMATS:
        raise MeshError(f"mesh file '{path}' ends in '{path.suffix}'; allowed are {', '.join(FORMATS)}. Convert it, "
                        "e.g. with MeshLab.")
    try:
        return path.read_bytes()
    except OSError as error:
        raise MeshError(f"mesh file '{path}' cannot be read: {error.strerror}. Give the path of an OBJ, PLY, STL or "
                        "OFF file, relative to the scene file.") from error


def extents(shape: MeshFile) -> np.ndarray:
    """Edges of the file's bounding box (3,) [m].

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces or is not finite.
    """
    return _extents(shape, content(shape)).copy()


@functools.lru_cache(maxsize=16)
def _extents(shape: MeshFile, content: bytes) -> np.ndarray:
    path = Path(shape.path)
    found = _finite(parse(content, path), path)
    size = np.ptp(found.vertices @ _UP[shape.up].T, axis=0)
    return size * _metres_per_unit(shape, float(size.max()))


def read_surface(shape: MeshFile) -> Surface:
    """The surface of a mesh file, repaired.

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces, is not finite, is flat, or is too large or too
            small.
    """
    path = Path(shape.path)
    file = _finite(parse(content(shape), path), path)
    notes = list(file.notes)
    vertices = file.vertices @ _UP[shape.up].T
    if shape.up != "z":
        notes.append(f"Turned upright: the file's {shape.up} axis became z, as given.")
    longest = float(np.ptp(vertices, axis=0).max())
    scale = _metres_per_unit(shape, longest)
    if shape.scale is not None:
        notes.append(f"Scaled by {scale:g} metres per unit, as given.")
    elif scale != 1.0:
        notes.append(f"The bounding box is {longest:.4g} units long, more than {LARGEST:g}, so the file was read as "
                     f"millimetres; give scale (metres per unit) to say otherwise.")
    if not SMALLEST <= longest * scale <= LARGEST:
        raise MeshError(f"mesh file '{path}': its bounding box is {longest * scale:.4g} m long after a scale of "
                        f"{scale:g}; allowed is {SMALLEST:g} to {LARGEST:g} m. Give the right scale (metres per unit), "
                        f"e.g. {{ mesh = \"{path.name}\", scale = 0.01 }} for centimetres.")
    centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    vertices, centre = scale * (vertices - centre), scale * centre
    size = np.ptp(vertices, axis=0)
    spread = np.linalg.svd(vertices - vertices.mean(axis=0), compute_uv=False)
    if spread[2] < 1e-4 * spread[0]:
        raise MeshError(f"mesh file '{path}' is a flat sheet ({' x '.join(f'{e:.4g}' for e in size)} m) and "
                        "encloses no volume; give it thickness, e.g. with a solidify modifier.")
    colour = _mean_colour(file, vertices, notes)
    vertices, faces = _joined(vertices, file.faces, notes, path)
    faces = _wound_alike(vertices, faces, notes)
    vertices, faces = _capped(vertices, faces, notes)
    vertices, faces, cavities, parts, overlap = _by_nesting(vertices, faces, notes)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    moved = 0.5 * (low + high)
    mesh = trimesh.Trimesh(vertices - moved, faces, process=False)
    return Surface(vertices - moved, faces, centre + moved, cavities, parts,
                   bool(mesh.is_watertight and mesh.is_winding_consistent), overlap, colour, tuple(notes))


def _finite(file: Facets, path: Path) -> Facets:
    used, faces = np.unique(file.faces, return_inverse=True)
    vertices = file.vertices[used]
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise MeshError(f"mesh file '{path}': {bad} of {len(vertices)} vertices are not finite numbers (NaN or "
                        "infinite); export the mesh again.")
    return Facets(vertices, faces.reshape(-1, 3), None if file.colours is None else file.colours[used], file.notes)


def _metres_per_unit(shape: MeshFile, longest: float) -> float:
    if shape.scale is not None:
        return shape.scale
    return 1e-3 if longest > LARGEST else 1.0


def _mean_colour(file: Facets, vertices: np.ndarray, notes: list[str]) -> np.ndarray | None:
    if file.colours is None:
        return None
    a, b, c = (vertices[file.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not area.sum() > 0.0:
        return None
    colour = np.average(file.colours[file.faces].mean(axis=1), axis=0, weights=area)
    notes.append(f"The body has the mean colour of the scan, ({', '.join(f'{255 * v:.0f}' for v in colour)}) of 255; "
                 "its pattern is not shown.")
    return colour


def _joined(vertices: np.ndarray, faces: np.ndarray, notes: list[str], path: Path) -> tuple[np.ndarray, np.ndarray]:
    """One corner for those that lie on each other, and each face once."""
    given = len(faces)
    vertices, same = np.unique(vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[faces]
    pairs = cKDTree(vertices).query_pairs(_WELD * float(np.ptp(vertices, axis=0).max()), output_type="ndarray")
    if len(pairs):
        group = joined(np.arange(pairs.size)[:, None] // 2, pairs.ravel(), len(vertices))
        _, first = np.unique(group, return_index=True)
        vertices, faces = vertices[first], group[faces]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum.reduce([np.linalg.norm(u - v, axis=1) for u, v in ((a, b), (b, c), (c, a))])
    distinct = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    # a needle with three corners holds its neighbours together; it goes only if it has no area at all
    good = distinct & (area > 1e-14 * longest**2)
    if not good.any():
        raise MeshError(f"mesh file '{path}' has no faces with an area (of {given} given); a closed triangle "
                        "surface is needed.")
    if distinct.sum() < given:
        notes.append(f"Removed {given - int(distinct.sum())} degenerate faces.")
    faces = _once(faces[distinct], notes)
    return vertices, faces


def _once(faces: np.ndarray, notes: list[str]) -> np.ndarray:
    least = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (least + np.arange(3)) % 3, axis=1)
    sense = np.where(turned[:, 1] < turned[:, 2], 1, -1)
    _, first, group = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_inverse=True)
    group = group.reshape(-1)
    if len(first) == len(faces):
        return faces
    # two faces back to back are the wall between two parts that touch, or a surface that has both sides
    net = np.bincount(group, weights=sense)
    every, outer = faces[np.sort(first)], faces[np.sort(first[net != 0])]
    kept = outer if len(outer) and _open_edges(outer) <= _open_edges(every) else every
    notes.append(f"Removed {len(faces) - len(kept)} duplicate faces.")
    return kept


def _edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges (3 f, 2) of triangles (f, 3), face by face."""
    return faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)


def _open_edges(faces: np.ndarray) -> int:
    _, count = np.unique(np.sort(_edges(faces), axis=1), axis=0, return_counts=True)
    return int((count != 2).sum())


def _wound_alike(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> np.ndarray:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.is_winding_consistent:
        return faces
    trimesh.repair.fix_winding(mesh)
    made = np.asarray(mesh.faces)
    turned = int((made != faces).any(axis=1).sum())
    if turned:  # which of the two sides agree is decided later
        notes.append(f"Faces were wound inconsistently; turned {min(turned, len(faces) - turned)} of {len(faces)} to "
                     f"agree with their neighbours.")
    return made


def _capped(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Holes closed by a fan about the middle of their rim."""
    edges = _edges(faces)
    _, which, count = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    rim = edges[count[which.reshape(-1)] == 1]
    crowded = int((count > 2).sum())
    if not len(rim) and not crowded:
        return vertices, faces
    after: dict[int, list[int]] = {}
    for a, b in rim[:, ::-1].tolist():  # a cap runs along the rim the other way
        after.setdefault(a, []).append(b)
    caps: list[list[int]] = []
    middles: list[np.ndarray] = []
    left = 0
    for start in list(after):
        while after.get(start):
            loop, at = [start], after[start].pop()
            while at != start and after.get(at):
                loop.append(at)
                at = after[at].pop()
            if at != start or len(loop) < 3:
                left += len(loop)
                continue
            if len(loop) == 3:
                caps.append(loop)
                continue
            middles.append(vertices[loop].mean(axis=0))
            tip = len(vertices) + len(middles) - 1
            caps += [[a, b, tip] for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    closed = np.concatenate([vertices, *(m[None] for m in middles)]) if middles else vertices
    area = _area(closed, np.array(caps, int).reshape(-1, 3))
    share = area / (area + _area(vertices, faces))
    notes.append(f"Not watertight: {len(rim)} open edges and {crowded} edges with more than two faces"
                 + (f"; holes were closed, {100 * share:.2g} % of the surface" if caps else "")
                 + (f"; {left} open edges bound no hole and were left to the filler." if left else "."))
    return closed, np.concatenate([faces, np.array(caps, int).reshape(-1, 3)])


def _area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Volume enclosed by triangles that are wound outwards [m^3]; taken about their middle, so that the result for an
    open part does not depend on its position."""
    a, b, c = (vertices[faces[:, n]] - vertices[np.unique(faces)].mean(axis=0) for n in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def _by_nesting(vertices: np.ndarray, faces: np.ndarray,
                notes: list[str]) -> tuple[np.ndarray, np.ndarray, int, int, bool]:
    """Parts wound by their nesting, loose debris left out: vertices, faces, cavities, solids, whether parts overlap."""
    adjacency = trimesh.Trimesh(vertices, faces, process=False).face_adjacency
    part = joined(np.arange(adjacency.size)[:, None] // 2, adjacency.ravel(), len(faces))
    part = part if part.max() < 2000 else np.zeros_like(part)
    members = [np.flatnonzero(part == p) for p in range(part.max() + 1)]
    volume = np.array([signed_volume(vertices, faces[m]) for m in members])
    spots = [vertices[np.unique(faces[m])] for m in members]
    spots = [s[::max(1, len(s) // 24)] for s in spots]
    low = np.array([vertices[np.unique(faces[m])].min(axis=0) for m in members])
    high = np.array([vertices[np.unique(faces[m])].max(axis=0) for m in members])
    depth = np.zeros(len(members), int)
    meets = np.zeros((len(members),) * 2, bool)
    for i, j in np.argwhere((low[:, None] <= high[None]).all(axis=2) & (high[:, None] >= low[None]).all(axis=2)):
        if i == j:
            continue
        inside = np.abs(winding_number(vertices, faces[members[j]], spots[i]))
        if (inside > 0.5).mean() > 0.9 and abs(volume[i]) < abs(volume[j]):
            depth[i] += 1
        elif (inside > 0.2).any():
            meets[i, j] = meets[j, i] = True
    faces = faces.copy()
    turned = solid_inside = 0
    for p, mine in enumerate(members):
        if (volume[p] > 0.0) != (depth[p] % 2 == 0):
            faces[mine] = faces[mine][:, ::-1]
            turned += len(mine)
            solid_inside += depth[p] % 2
    if turned:
        notes.append(f"{turned} of {len(faces)} faces were inside out; turned them round."
                     + (f" {solid_inside} parts inside another were wound as solids and are cavities." if solid_inside
                        else ""))
    size = np.abs(volume)
    # what lies in a cavity is loose, and so is what nothing touches
    loose = (depth % 2 == 0) & (size <= DEBRIS * size.max()) & ~meets.any(axis=1)
    if loose.any():
        notes.append(f"Dropped {int(loose.sum())} loose pieces, {100 * size[loose].sum() / size.sum():.2g} % of the "
                     "volume.")
        faces = faces[np.concatenate([members[p] for p in np.flatnonzero(~loose)])]
    used, local = np.unique(faces, return_inverse=True)
    stay = depth[~loose]
    return (vertices[used], local.reshape(-1, 3), int((stay % 2).sum()), int((stay % 2 == 0).sum()),
            bool(meets[~loose][:, ~loose].any()))
