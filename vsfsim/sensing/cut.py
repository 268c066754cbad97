"""A body of tetrahedra cut open by a plane: what is left of its surface, and the elements on the face of the cut.

The plane cuts the body at rest. Every vertex of what is left lies on an edge of the mesh or in a node, so that the
same cut can be drawn of each deformed state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.core.solid import boundary_faces
from vsfsim.sensing.surface import Surface

_PARTS = np.array([[0, 4, 6, 7], [1, 5, 4, 8], [2, 6, 5, 9], [3, 8, 7, 9],
                  [4, 5, 6, 7], [4, 5, 7, 8], [5, 9, 7, 8], [5, 9, 6, 7]])
"""A quadratic tetrahedron, with nodes on the edges 01 12 20 03 13 23, as eight linear ones."""
_SEAM = 0.04  # half the width of the line between two elements on the face of the cut, over their size
_LIFT = 3e-4  # of the elements over these lines, over the size of the body


@dataclass(frozen=True)
class Elements:
    """A body of n nodes and m linear tetrahedra."""

    points: np.ndarray
    """Nodes at rest (n, 3) [m]."""
    tets: np.ndarray
    """Their indices (m, 4)."""
    young_modulus: np.ndarray
    """Of each tetrahedron, the mean over its element (m,) [Pa]."""
    element: np.ndarray
    """The element that each tetrahedron is a part of (m,)."""

    @classmethod
    def of_quadratic(cls, points: np.ndarray, tets: np.ndarray, young_modulus: np.ndarray) -> Elements:
        """Tetrahedra of ten nodes (m, 10), each as eight linear ones."""
        element = np.repeat(np.arange(len(tets)), len(_PARTS))
        return cls(points, tets[:, _PARTS].reshape(-1, 4), young_modulus[element], element)

    def hidden(self) -> np.ndarray:
        """The middle of what differs most from the median of log E, of a uniform body its own middle (3,) [m]."""
        log, centres = np.log(self.young_modulus), self.points[self.tets].mean(axis=1)
        weight = np.abs(log - np.median(log))
        if weight.sum() < 1e-6 * len(log):
            return 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))
        return np.average(centres, axis=0, weights=weight)


@dataclass(frozen=True)
class Cut:
    """What a plane leaves of a body. Of k vertices the first n are the body's nodes."""

    ends: np.ndarray
    """Two nodes for each vertex (k, 2)."""
    share: np.ndarray
    """Where it lies between them (k,) [-]."""
    triangles: np.ndarray
    """Of the surface that is left, then of the face of the cut (f, 3)."""
    owner: np.ndarray
    """Tetrahedron of each triangle (f,)."""
    face: np.ndarray
    """Whether a triangle is on the face of the cut (f,)."""

    def at(self, nodal: np.ndarray) -> np.ndarray:
        """Values at the vertices (k, ...) of values at the nodes (n, ...)."""
        a, b = (nodal[self.ends[:, i]] for i in (0, 1))
        return a + self.share.reshape(-1, *[1] * (nodal.ndim - 1)) * (b - a)


def cut(body: Elements, away: np.ndarray, normal: np.ndarray) -> Cut:
    """Cut a body by a plane.

    Args:
        body: at rest.
        away: of each node, how far it is on the side that is taken off (n,) [m].
        normal: of the plane, towards that side (3,) [-]: the face of the cut is wound about it.
    """
    triangles, owner = boundary_faces(body.tets)
    ends, n = [np.repeat(np.arange(len(body.points))[:, None], 2, axis=1)], len(body.points)
    whole = (away[triangles] <= 0.0).all(axis=1)
    out, whose = [triangles[whole]], [owner[whole]]

    def add(cells: np.ndarray, of: np.ndarray, corners: list[tuple[int, int]]) -> None:
        """A polygon in each cell, whose corners are nodes (i, i) or lie on edges (i, j)."""
        nonlocal n
        pairs = np.stack([cells[:, list(pair)] for pair in corners], axis=1)
        ends.append(pairs.reshape(-1, 2))
        index = n + np.arange(len(cells) * len(corners)).reshape(-1, len(corners))
        index = np.where(pairs[:, :, 0] == pairs[:, :, 1], pairs[:, :, 0], index)
        n += index.size
        for k in range(2, len(corners)):
            out.append(index[:, [0, k - 1, k]])
            whose.append(of)

    def sorted_by_side(cells: np.ndarray, of: np.ndarray, kept: int) -> tuple[np.ndarray, np.ndarray]:
        """Cells of which so many nodes are kept, these first."""
        side = away[cells] > 0.0
        some = (~side).sum(axis=1) == kept
        order: np.ndarray = np.argsort(side[some], axis=1, kind="stable")
        if order.shape[1] == 3:  # a triangle keeps its sense
            order = (order[:, [0 if kept == 1 else 2]] + [[0, 1, 2] if kept == 1 else [1, 2, 0]]) % 3
        return np.take_along_axis(cells[some], order, axis=1), of[some]

    add(*sorted_by_side(triangles, owner, 1), [(0, 0), (0, 1), (0, 2)])
    add(*sorted_by_side(triangles, owner, 2), [(0, 0), (1, 1), (1, 2), (0, 2)])
    surface = sum(map(len, out))
    every = np.arange(len(body.tets))
    add(*sorted_by_side(body.tets, every, 1), [(0, 1), (0, 2), (0, 3)])
    add(*sorted_by_side(body.tets, every, 2), [(0, 2), (0, 3), (1, 3), (1, 2)])
    add(*sorted_by_side(body.tets, every, 3), [(0, 3), (1, 3), (2, 3)])
    pairs, faces = np.concatenate(ends), np.concatenate(out)
    span = away[pairs[:, 0]] - away[pairs[:, 1]]
    share = np.where(span == 0.0, 0.0, away[pairs[:, 0]] / np.where(span == 0.0, 1.0, span))
    found = Cut(pairs, share, faces, np.concatenate(whose), np.arange(len(faces)) >= surface)
    a, b, c = np.moveaxis(found.at(body.points)[faces], 1, 0)
    turned = found.face & (np.cross(b - a, c - a) @ normal < 0.0)
    faces[turned] = faces[turned][:, ::-1]
    return found


def opened(body: Elements, normal: np.ndarray, place: np.ndarray, moved: np.ndarray | None = None,
           ) -> tuple[Surface, np.ndarray]:
    """A body without what lies beyond a plane, as a surface whose elements are apart on the face of the cut.

    Args:
        body: at rest.
        normal: unit normal of the plane, towards what is taken off (3,) [-].
        place: a point of the plane at rest (3,) [m].
        moved: displacements of the nodes that are drawn (n, 3) [m]; None for the body at rest.

    Returns:
        The surface, and the tetrahedron that each triangle shows (f,); -1 is a line between elements.
    """
    found = cut(body, (body.points - place) @ normal, normal)
    vertices = found.at(body.points if moved is None else body.points + moved)
    face, element = found.triangles[found.face], body.element[found.owner[found.face]]
    corners = vertices[face]
    count = np.bincount(element, minlength=element.max(initial=0) + 1)
    middle = np.stack([np.bincount(element, corners.mean(axis=1)[:, k]) for k in range(3)], axis=1) / np.maximum(
        count, 1)[:, None]
    lift = _LIFT * float(np.ptp(body.points, axis=0).max()) * normal
    inner = middle[element][:, None] + (1.0 - 2.0 * _SEAM) * (corners - middle[element][:, None]) + lift
    triangles = np.concatenate([found.triangles, len(vertices) + np.arange(3 * len(face)).reshape(-1, 3)])
    vertices = np.concatenate([vertices, inner.reshape(-1, 3)])
    shows = np.concatenate([np.where(found.face, -1, found.owner), found.owner[found.face]])
    return Surface(vertices, triangles, np.zeros(len(triangles), int), None, vertices), shows


def facing(body: Elements, place: np.ndarray) -> np.ndarray:
    """The normal (3,), along -y or x, of the plane through a ``place`` (3,) [m] that shows more of what differs from
    the median of log E."""
    log = np.log(body.young_modulus)
    contrast = np.abs(log - np.median(log))
    normals = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    side = ((body.points - place) @ normals.T)[body.tets] > 0.0
    met = side.any(axis=1) & ~side.all(axis=1)
    return normals[int(contrast[met[:, 1]].sum() > 1.05 * contrast[met[:, 0]].sum())]


def halved(vertices: np.ndarray, triangles: np.ndarray, normal: np.ndarray, place: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray]:
    """A rigid body that its middle sees the whole surface of, without what lies beyond a plane: vertices, triangles."""
    points = np.concatenate([vertices, vertices.mean(axis=0, keepdims=True)])
    tets = np.concatenate([np.full((len(triangles), 1), len(vertices)), triangles], axis=1)
    found = cut(Elements(points, tets, np.ones(len(tets)), np.arange(len(tets))), (points - place) @ normal, normal)
    return found.at(points), found.triangles
