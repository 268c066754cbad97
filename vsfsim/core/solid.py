"""A body before any model is made of it: a tetrahedral volume with named regions and a look."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vsfsim.core.material import Foam


@dataclass(frozen=True)
class Appearance:
    """How each region looks to a camera."""

    albedo: np.ndarray
    """Base colour of each region, linear RGB in 0..1 (R, 3)."""
    texture: tuple[str, ...]
    """Kind of procedural texture of each region, one of `TEXTURES` (R,)."""
    texture_scale: np.ndarray
    """Wavelength of the texture (R,) [m]."""
    texture_contrast: np.ndarray
    """Relative amplitude of the texture, 0..1 (R,)."""


TEXTURES = ("plain", "noise", "weave", "grain", "stripes", "laces", "tread", "seams")


@dataclass(frozen=True)
class Law:
    """The material of one region besides its Young's modulus."""

    poisson_ratio: float
    """At small strain [-]."""
    density: float
    """[kg/m^3]."""
    foam: Foam | None = None
    """The hyperfoam law, scaled to the region's Young's modulus; None for the neo-Hookean law. Its Poisson's ratio
    counts."""


@dataclass(frozen=True)
class Solid:
    """A watertight volume filled with tetrahedra, in the object's own frame."""

    vertices: np.ndarray
    """Corner positions (n, 3) [m]."""
    tets: np.ndarray
    """Corner indices of each tetrahedron, positively oriented (m, 4)."""
    region: np.ndarray
    """Region of each tetrahedron, an index into `region_names` (m,)."""
    region_names: tuple[str, ...]
    """At least one."""
    young_modulus: np.ndarray | None = None
    """Of each region (R,) [Pa], or None where the scene gives a field instead."""
    appearance: Appearance | None = None
    """Of each region, or None for a plain grey."""
    notes: tuple[str, ...] = field(default=())
    """Repairs and decisions, one sentence each."""
    laws: tuple[Law, ...] | None = None
    """Of each region (R,), or None where the scene gives one material for the whole object."""
    nearest: Callable[[np.ndarray], np.ndarray] | None = None
    """Gives the nearest points (k, 3) of the true surface to points (k, 3) [m], where the surface is curved and known:
    edges of elements follow it. None for a body with flat faces."""
    parts: float = 0.0
    """By which share of its own the stiffness of a part inside is off in the mesh, the largest of all parts [-]."""

    def volume(self) -> float:
        """Volume of the tetrahedra, whose sides are flat [m^3]; a solver's mesh has round faces."""
        return float(tet_volumes(self.vertices, self.tets).sum())

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Boundary triangles, wound outwards, and the tetrahedron behind each: (f, 3), (f,)."""
        return boundary_faces(self.tets)


def tet_volumes(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Signed volumes (m,) [m^3] of tetrahedra ``tets`` (m, 4) on ``vertices`` (n, 3) [m]."""
    a, b, c, d = (vertices[tets[:, k]] for k in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6.0


# Face k is opposite corner k and wound outwards for a positively oriented tetrahedron.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])


def boundary_faces(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces that belong to one tetrahedron only.

    Args:
        tets: (m, 4) positively oriented corner indices.

    Returns:
        Triangles (f, 3) wound outwards, and the index of the tetrahedron behind each (f,).
    """
    faces = tets[:, TET_FACES].reshape(-1, 3)
    owner = np.repeat(np.arange(len(tets)), 4)
    key = np.sort(faces, axis=1)
    _, first, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    once = np.sort(first[count == 1])
    return faces[once], owner[once]


_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def smallest_sine(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Smallest sine of the dihedral angles of each tetrahedron (m,), negative if it is inverted.

    The sine at an edge is 3/2 of volume times edge length over the areas of the two faces there. It is what
    a mesh is improved by.
    """
    volume = tet_volumes(vertices, tets)
    corner = vertices[tets]
    area = {}
    for k, (a, b, c) in enumerate(((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))):
        area[k] = 0.5 * np.linalg.norm(np.cross(corner[:, b] - corner[:, a], corner[:, c] - corner[:, a]), axis=1)
    out = np.full(len(tets), np.inf)
    for i, j in _EDGES:
        k, m = (n for n in range(4) if n not in (i, j))
        length = np.linalg.norm(corner[:, i] - corner[:, j], axis=1)
        # The faces at edge ij are the ones opposite k and m. A collapsed face counts as a sine of 0.
        np.minimum(out, 1.5 * volume * length / np.maximum(area[k] * area[m], 1e-300), out=out)
    return out
