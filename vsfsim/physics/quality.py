"""Shape quality of tetrahedra: dihedral angles."""

from __future__ import annotations

import numpy as np

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
