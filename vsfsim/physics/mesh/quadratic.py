"""From corner tetrahedra to the quadratic mesh of the solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from vsfsim.core.solid import TET_FACES, Solid, boundary_faces, tet_volumes
from vsfsim.core.system.exact import inverse3
from vsfsim.physics.elements.block import Block
from vsfsim.physics.elements.tet10_shape import EDGES, GAUSS_FAR, GAUSS_NEAR

# The six nodes of face k of a tetrahedron: its three corners (as TET_FACES winds them), then the edges between them.
_EDGE_OF = {frozenset(map(int, e)): 4 + i for i, e in enumerate(EDGES)}
FACE_NODES = np.array([
    [*map(int, f), _EDGE_OF[frozenset(map(int, f[[0, 1]]))], _EDGE_OF[frozenset(map(int, f[[1, 2]]))],
     _EDGE_OF[frozenset(map(int, f[[2, 0]]))]] for f in TET_FACES
])


@dataclass(frozen=True)
class QuadraticMesh:
    """Ten-node tetrahedra with straight sides, in the object's frame."""

    points: np.ndarray
    """Nodes, the corners first (n, 3) [m]."""
    tets: np.ndarray
    """Nodes of the tetrahedra (m, 10): corners, then the edges of `tet10_shape.EDGES`."""
    gradients: np.ndarray
    """Gradients of the four barycentric coordinates (m, 4, 3) [1/m]."""
    volume: np.ndarray
    """Volumes (m,) [m^3]."""
    faces: np.ndarray
    """Boundary triangles, wound outwards (f, 6): corners, then edge nodes."""
    owner: np.ndarray
    """Tetrahedron behind each boundary triangle (f,)."""

    def surface_nodes(self) -> np.ndarray:
        """Indices of the nodes on the boundary (s,), increasing."""
        return np.unique(self.faces)

    def face_area(self) -> np.ndarray:
        """Areas of the boundary triangles (f,) [m^2]."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def gauss_points(solid: Solid) -> np.ndarray:
    """Positions of the four Gauss points of every tetrahedron (m, 4, 3) [m]."""
    bary = np.full((4, 4), GAUSS_FAR)
    np.fill_diagonal(bary, GAUSS_NEAR)
    return np.einsum("qk,mkc->mqc", bary, solid.vertices[solid.tets])


def quadratic_mesh(solid: Solid) -> QuadraticMesh:
    """Put a node in the middle of every edge.

    Args:
        solid: positively oriented corner tetrahedra.
    """
    tets = np.asarray(solid.tets, np.int64)
    corners = np.asarray(solid.vertices, float)
    pairs = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    middle = corners[edges].mean(axis=1)
    tets10 = np.hstack([tets, len(corners) + inverse.reshape(len(tets), 6)])
    volume = tet_volumes(corners, tets)
    assert (volume > 0).all(), "tetrahedra must be positively oriented"
    frame = corners[tets[:, 1:]] - corners[tets[:, :1]]  # rows: edges from corner 0
    inv = inverse3(frame)  # columns: gradients of coordinates 1..3
    gradients = np.empty((len(tets), 4, 3))
    gradients[:, 1:] = inv.transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    faces, owner = boundary_faces(tets)
    # find which face of its owner each boundary triangle is: the corner of the owner that it does not have
    local = np.array([[c in f for c in t] for f, t in zip(faces, tets[owner], strict=True)])
    opposite = np.argmin(local, axis=1)
    faces6 = np.take_along_axis(tets10[owner], FACE_NODES[opposite], axis=1)
    return QuadraticMesh(np.vstack([corners, middle]), tets10.astype(np.int32), gradients, volume,
                         faces6.astype(np.int32), owner)


def assemble(points: int, blocks: tuple[Block, ...]) -> sp.csr_matrix:
    """Stiffness of all ``blocks`` at rest, supports not held, (3 n, 3 n) [N/m], for n = ``points`` nodes."""
    total = sp.csr_matrix((3 * points, 3 * points))
    for block in blocks:
        values = block.element.rest_stiffness(block)
        if not len(values):
            continue
        size = values.shape[1]
        dof = (3 * block.nodes[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(block), size)
        row, column = np.repeat(dof, size, axis=1).ravel(), np.tile(dof, (1, size)).ravel()
        total = total + sp.coo_matrix((values.ravel(), (row, column)), shape=total.shape).tocsr()
    return total
