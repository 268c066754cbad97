"""Shape quality of tetrahedra: dihedral angles."""

from __future__ import annotations

import numpy as np

from vsfsim.core.solid import tet_volumes

_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))


def dihedral_angles(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """The six angles between the faces of each tetrahedron (m, 6) [rad].

    Args:
        vertices: (n, 3) [m].
        tets: (m, 4) corner indices. An inverted or flat tetrahedron gives angles of 0 and pi.
    """
    out = np.empty((len(tets), 6))
    corner = vertices[tets]
    for e, (i, j) in enumerate(_EDGES):
        k, m = (n for n in range(4) if n not in (i, j))
        axis = corner[:, j] - corner[:, i]
        first = np.cross(axis, corner[:, k] - corner[:, i])
        second = np.cross(axis, corner[:, m] - corner[:, i])
        sine = np.linalg.norm(np.cross(first, second), axis=1)
        out[:, e] = np.arctan2(sine, np.einsum("ij,ij->i", first, second))
    return out


def worst_angle(vertices: np.ndarray, tets: np.ndarray) -> float:
    """Smallest of all dihedral angles and their supplements [rad]: small for needles and for flat slivers alike."""
    angles = dihedral_angles(vertices, tets)
    return float(np.minimum(angles, np.pi - angles).min())


def smallest_sine(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Smallest sine of the dihedral angles of each tetrahedron (m,), negative if it is inverted.

    The sine at an edge is 3/2 of volume times edge length over the areas of the two faces there. Cheaper than
    `dihedral_angles`, and what a mesh is improved by.
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
