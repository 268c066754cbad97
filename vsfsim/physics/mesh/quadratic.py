"""From corner tetrahedra to the quadratic mesh of the solver."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from vsfsim.core.solid import Solid, boundary_faces, tet_volumes
from vsfsim.core.system.exact import inverse3
from vsfsim.physics.elements.block import Block
from vsfsim.physics.elements.tet10_shape import EDGES, GAUSS, jacobians, shape_derivatives, shape_gradients

ON_FACE = [0, 1, 2, 4, 5, 6]
"""Nodes of a tetrahedron on the face of its first three corners: these, then the edges between them."""


def face_slopes(bary: np.ndarray) -> np.ndarray:
    """Derivatives of a face's shape functions by its last two barycentric coordinates (k, 6, 2) [-] at barycentric
    coordinates (k, 3)."""
    return shape_derivatives(np.pad(bary, ((0, 0), (0, 1))))[:, ON_FACE, :2]


_FACE_SLOPES = face_slopes(1 / 6 + 0.5 * np.eye(3))
_NODES = np.vstack([np.eye(4), 0.5 * (np.eye(4)[EDGES[:, 0]] + np.eye(4)[EDGES[:, 1]])])
_STRAIGHT = 1e-18  # squared bulge of an edge over its squared length up to which it is rounding error
_FOLDED = 0.2  # least Jacobian at a node over that of straight edges
_ON_SURFACE = 1e-2  # distance of a corner from the true surface over the shortest side of its face
_MOST_BENT = 0.15  # of an edge's middle over its length: an arc of 67 degrees; beyond it the edge crosses a sharp one


@dataclass(frozen=True)
class QuadraticMesh:
    """Ten-node tetrahedra, in the object's frame. Nodes of edges on a curved surface lie on it."""

    points: np.ndarray
    """Nodes, the corners first (n, 3) [m]."""
    tets: np.ndarray
    """Nodes of the tetrahedra (m, 10): corners, then the edges of `tet10_shape.EDGES`."""
    gradients: np.ndarray
    """Gradients of the last three barycentric coordinates at the four Gauss points (m, 4, 3, 3) [1/m]."""
    weights: np.ndarray
    """Volume of each Gauss point (m, 4) [m^3]."""
    faces: np.ndarray
    """Boundary triangles, wound outwards (f, 6): corners, then edge nodes."""
    owner: np.ndarray
    """Tetrahedron behind each boundary triangle (f,)."""

    @functools.cached_property
    def mean_gradients(self) -> np.ndarray:
        """Gradients of the shape functions, their mean over the Gauss points (m, 10, 3) [1/m]."""
        return shape_gradients(self.gradients).mean(axis=1)

    @functools.cached_property
    def corner_jacobians(self) -> np.ndarray:
        """Determinants of the tetrahedra at rest at their corners (m, 4) [m^3], see `tet10_shape.jacobians`."""
        return jacobians(self.points[self.tets], np.eye(4))[1]

    @property
    def volume(self) -> np.ndarray:
        """Volumes of the tetrahedra (m,) [m^3]."""
        return self.weights.sum(axis=1)

    def surface_nodes(self) -> np.ndarray:
        """Indices of the nodes on the boundary (s,), increasing."""
        return np.unique(self.faces)

    def face_area(self) -> np.ndarray:
        """Areas of the boundary triangles (f,) [m^2]; of curved ones by a rule of three points."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        area, (chord, bulge) = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1), self._sides()
        bent = ((bulge**2).sum(axis=2) > _STRAIGHT * (chord**2).sum(axis=2)).any(axis=1)
        u, v = np.moveaxis(np.einsum("qal,fac->fqlc", _FACE_SLOPES, self.points[self.faces[bent]]), 2, 0)
        area[bent] = 0.5 * np.linalg.norm(np.cross(u, v), axis=2).mean(axis=1)
        return area

    def curvature(self) -> np.ndarray:
        """Mean curvature of the boundary triangles at rest (f,) [1/m], by how far their edges bulge outwards."""
        chord, bulge = self._sides()
        outward = np.cross(chord[:, 0], chord[:, 1])
        sagitta = np.einsum("fei,fi->fe", bulge, outward) / np.linalg.norm(outward, axis=1)[:, None]
        square = (chord**2).sum(axis=2)
        return np.where(sagitta**2 > _STRAIGHT * square, 8.0 * sagitta / square, 0.0).mean(axis=1)

    def _sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Chords of the edges of the boundary triangles (f, 3, 3) [m], and how far their middles are from them."""
        corners = self.points[self.faces[:, :3]]
        chord = np.roll(corners, -1, axis=1) - corners
        return chord, self.points[self.faces[:, 3:]] - corners - 0.5 * chord


def gauss_points(solid: Solid) -> np.ndarray:
    """Positions of the four Gauss points of every tetrahedron between its corners (m, 4, 3) [m]."""
    return np.einsum("qk,mkc->mqc", GAUSS, solid.vertices[solid.tets])


def edges_of(cells: np.ndarray, sides: np.ndarray | list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Ends of all edges (e, 2), in increasing order, and the edges of each of the ``cells`` (m, k), whose ``sides``
    (s, 2) are between these of its corners: (m, s)."""
    pairs = np.sort(np.asarray(cells, np.int64)[:, sides], axis=2)
    count = pairs.max() + 1
    # one number for both ends: several times faster than rows
    ends, edge = np.unique(pairs @ np.array([count, 1]), return_inverse=True)
    return np.stack(np.divmod(ends, count), axis=1), edge.reshape(pairs.shape[:2])


def quadratic_mesh(solid: Solid) -> QuadraticMesh:
    """Put a node in the middle of every edge, or on the true surface where the body has one.

    Args:
        solid: positively oriented corner tetrahedra.
    """
    tets = np.asarray(solid.tets, np.int64)
    corners = np.asarray(solid.vertices, float)
    edges, edge = edges_of(tets, EDGES)
    tets10 = np.hstack([tets, len(corners) + edge])
    volume = tet_volumes(corners, tets)
    assert (volume > 0).all(), "tetrahedra must be positively oriented"
    middle = corners[edges].mean(axis=1)
    bent = round_middles(solid, edges)
    while True:
        points = np.vstack([corners, middle + bent])
        folded = (jacobians(points[tets10], _NODES)[1] < _FOLDED * 6.0 * volume[:, None]).any(axis=1)
        if not folded.any():
            break
        bent[edge[folded]] = 0.0  # straight edges never fold
    jacobian, determinant = jacobians(points[tets10], GAUSS)
    faces, owner = boundary_faces(tets)
    # an edge is found by a number that grows in the order of `edges`
    number, sides = np.array([len(corners), 1]), np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    between = len(corners) + np.searchsorted(edges @ number, np.sort(sides, axis=2) @ number)
    return QuadraticMesh(points, tets10.astype(np.int32), np.swapaxes(inverse3(jacobian), 2, 3),
                         determinant / 24.0, np.hstack([faces, between]).astype(np.int32), owner)


def round_middles(solid: Solid, edges: np.ndarray) -> np.ndarray:
    """How far the middles of ``edges`` (k, 2) are from the true surface (k, 3) [m]; 0 where a body has none, inside it,
    and where a sharp edge lies between the corners.

    An edge follows the surface if all corners of a face beside it lie there.
    """
    out = np.zeros((len(edges), 3))
    if solid.nearest is None:
        return out
    faces, _ = boundary_faces(solid.tets)
    sides = np.sort(np.stack([faces, np.roll(faces, 1, axis=1)], axis=2), axis=2)  # (f, 3, 2)
    length = np.linalg.norm(np.diff(solid.vertices[sides], axis=2)[:, :, 0], axis=2)
    used, at = np.unique(faces, return_inverse=True)
    off = np.linalg.norm(solid.nearest(solid.vertices[used]) - solid.vertices[used], axis=1)[at.reshape(faces.shape)]
    key = edges[:, 0] * np.int64(len(solid.vertices)) + edges[:, 1]
    beside = sides[(off < _ON_SURFACE * length.min(axis=1)[:, None]).all(axis=1)].reshape(-1, 2)
    rows = np.flatnonzero(np.isin(key, beside[:, 0] * np.int64(len(solid.vertices)) + beside[:, 1]))
    ends = solid.vertices[edges[rows]]
    found = solid.nearest(ends.mean(axis=1)) - ends.mean(axis=1)
    near = np.linalg.norm(found, axis=1) < _MOST_BENT * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    out[rows[near]] = found[near]
    return out


def assemble(points: int, blocks: tuple[Block, ...]) -> sp.csr_matrix:
    """Stiffness of all ``blocks`` at rest, supports not held, (3 n, 3 n) [N/m], for n = ``points`` nodes."""
    total = sp.csr_matrix((3 * points, 3 * points))
    for block in blocks:
        values = block.rest_stiffness()
        if not len(values):
            continue
        size = values.shape[1]
        dof = (3 * block.nodes[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(block), size)
        row, column = np.repeat(dof, size, axis=1).ravel(), np.tile(dof, (1, size)).ravel()
        total = total + sp.coo_matrix((values.ravel(), (row, column)), shape=total.shape).tocsr()
    return total
