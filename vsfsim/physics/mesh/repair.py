"""A user's surface mesh, in metres about the centre of its box, with every part wound by its nesting.

One reader for objects and probes. Corners that lie on each other are joined, faces given twice or without an area are
left out, holes are closed by a fan over their rim. A part inside another is a cavity, whatever way it is
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
from vsfsim.physics.elements import gas
from vsfsim.physics.mesh.formats import parse
from vsfsim.physics.mesh.surface_distance import SurfaceDistance
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
    parts: int
    """Parts that bound a solid."""
    watertight: bool
    """Whether every edge has two faces, wound alike."""
    overlap: bool
    """Whether parts may overlap: their boxes do, and neither lies in the other."""
    notes: tuple[str, ...]
    """One sentence per repair."""

    @property
    def extents(self) -> np.ndarray:
        """Edges of the bounding box (3,) [m]."""
        return np.ptp(self.vertices, axis=0)


def read_surface(shape: MeshFile) -> Surface:
    """The surface of a mesh file, repaired, once in a process.

    Raises:
        MeshError: the file is unreadable, or the mesh has no faces, is not finite, is flat, or is too large or too
            small.
    """
    return _repaired(shape, shape.content())


@functools.lru_cache(maxsize=16)
def _repaired(shape: MeshFile, content: bytes) -> Surface:
    path = Path(shape.path)
    file = parse(content, path)
    used, faces = np.unique(file.faces, return_inverse=True)
    vertices, faces = file.vertices[used] @ _UP[shape.up].T, faces.reshape(-1, 3)
    if bad := int((~np.isfinite(vertices)).any(axis=1).sum()):
        raise MeshError(f"mesh file '{path}': {bad} of {len(vertices)} vertices are not finite numbers (NaN or "
                        "infinite); export the mesh again.")
    notes: list[str] = []
    if shape.up != "z":
        notes.append(f"Turned upright: the file's {shape.up} axis became z, as given.")
    longest = float(np.ptp(vertices, axis=0).max())
    scale = shape.scale if shape.scale is not None else 1e-3 if longest > LARGEST else 1.0
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
    mesh = trimesh.Trimesh(*_joined(vertices, faces, notes, path), process=False)
    _wind_alike(mesh, notes)
    _cap(mesh, notes)
    vertices, faces, parts, overlap = _by_nesting(np.asarray(mesh.vertices), np.asarray(mesh.faces), notes)
    moved = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    mesh = trimesh.Trimesh(vertices - moved, faces, process=False)
    return Surface(vertices - moved, faces, centre + moved, parts,
                   bool(mesh.is_watertight and mesh.is_winding_consistent), overlap, tuple(notes))


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


def _open_edges(faces: np.ndarray) -> int:
    _, count = np.unique(np.sort(trimesh.geometry.faces_to_edges(faces), axis=1), axis=0, return_counts=True)
    return int((count != 2).sum())


def _wind_alike(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    if mesh.is_winding_consistent:
        return
    given = np.array(mesh.faces)
    trimesh.repair.fix_winding(mesh)
    turned = int((np.asarray(mesh.faces) != given).any(axis=1).sum())
    if turned:  # which of the two sides agree is decided later
        notes.append(f"Faces were wound inconsistently; turned {min(turned, len(given) - turned)} of {len(given)} to "
                     f"agree with their neighbours.")


def _cap(mesh: trimesh.Trimesh, notes: list[str]) -> None:
    """Close holes by a fan over their rim."""
    _, count = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
    if (count == 2).all():
        return
    given, area = len(mesh.faces), mesh.area
    trimesh.repair.fill_holes(mesh, use_fan=True)
    notes.append(f"Not watertight: {int((count == 1).sum())} open edges and {int((count > 2).sum())} edges with more "
                 f"than two faces" + (f"; holes were closed, {100 * (1.0 - area / mesh.area):.2g} % of the surface."
                                      if len(mesh.faces) > given else "."))


def _by_nesting(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray, int, bool]:
    """Parts wound by their nesting, loose debris left out: vertices, faces, solids, whether parts overlap."""
    adjacency = trimesh.Trimesh(vertices, faces, process=False).face_adjacency
    part = trimesh.graph.connected_component_labels(adjacency, node_count=len(faces))
    part = part if part.max() < 2000 else np.zeros_like(part)
    members = [np.flatnonzero(part == p) for p in range(part.max() + 1)]
    volume = np.array([gas.volume(vertices, faces[m]) for m in members])
    corners = [vertices[np.unique(faces[m])] for m in members]
    solids = [SurfaceDistance(vertices, faces[m] if v > 0.0 else faces[m][:, ::-1])
              for m, v in zip(members, volume, strict=True)]
    low, high = np.array([c.min(axis=0) for c in corners]), np.array([c.max(axis=0) for c in corners])
    depth = np.zeros(len(members), int)
    meets = np.zeros((len(members),) * 2, bool)
    for i, j in np.argwhere((low[:, None] <= high[None]).all(axis=2) & (high[:, None] >= low[None]).all(axis=2)):
        if i == j:
            continue
        spots = corners[i][::max(1, len(corners[i]) // 24)]
        inside = solids[j].inside(spots)
        if inside.mean() > 0.9 and abs(volume[i]) < abs(volume[j]):
            depth[i] += 1
        elif inside.any():
            meets[i, j] = meets[j, i] = True
    hollow = depth % 2 == 1
    wrong = (volume > 0.0) == hollow
    faces = np.where(wrong[part][:, None], faces[:, ::-1], faces)
    if wrong.any():
        cavities = int((wrong & hollow).sum())
        notes.append(f"{int(wrong[part].sum())} of {len(faces)} faces were inside out; turned them round."
                     + (f" {cavities} parts inside another were wound as solids and are cavities." if cavities else ""))
    size = np.abs(volume)
    # what lies in a cavity is loose, and so is what nothing touches
    loose = ~hollow & (size <= DEBRIS * size.max()) & ~meets.any(axis=1)
    if loose.any():
        notes.append(f"Dropped {int(loose.sum())} loose pieces, {100 * size[loose].sum() / size.sum():.2g} % of the "
                     "volume.")
    used, local = np.unique(faces[~loose[part]], return_inverse=True)
    return (vertices[used], local.reshape(-1, 3), int((~hollow & ~loose).sum()),
            bool(meets[~loose][:, ~loose].any()))
