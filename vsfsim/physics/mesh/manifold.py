"""Bodies of a tetrahedral mesh, and boundaries that touch themselves at a point or an edge."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vsfsim.core.solid import TET_FACES, boundary_faces, tet_volumes


def body_of_each_tet(tets: np.ndarray) -> np.ndarray:
    """Number of the body each tetrahedron belongs to (m,); bodies are joined through faces."""
    key = np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(key.T)
    same = (key[order][1:] == key[order][:-1]).all(axis=1)
    owner = np.repeat(np.arange(len(tets)), 4)[order]
    one, two = owner[:-1][same], owner[1:][same]
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=(len(tets), len(tets)))
    return connected_components(graph, directed=False)[1]


def shells(faces: np.ndarray) -> list[np.ndarray]:
    """Triangles (f, 3) of a closed boundary, parted into those that edges join."""
    edge = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edge.T)
    same = (edge[order][1:] == edge[order][:-1]).all(axis=1)
    owner = order // 3
    graph = coo_matrix((np.ones(int(same.sum())), (owner[:-1][same], owner[1:][same])), shape=(len(faces),) * 2)
    amount, part = connected_components(graph, directed=False)
    return [faces[part == p] for p in range(amount)]


def pinched_vertices(tets: np.ndarray) -> np.ndarray:
    """Vertices where the boundary is not one sheet: its faces there form more than one fan (k,).

    The ends of an edge with four boundary faces are among them.
    """
    faces, _ = boundary_faces(tets)
    # A corner (face f at vertex v) is next to the corner of v in the face across each edge of f at v.
    corner = np.arange(faces.size)
    vertex = faces.reshape(-1)
    after, before = np.roll(faces, -1, axis=1).reshape(-1), np.roll(faces, 1, axis=1).reshape(-1)
    edge = np.concatenate([np.stack([vertex, after], 1), np.stack([vertex, before], 1)])
    both = np.concatenate([corner, corner])
    order = np.lexsort(edge.T)
    same = (edge[order][1:] == edge[order][:-1]).all(axis=1)
    one, two = both[order][:-1][same], both[order][1:][same]
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=(faces.size, faces.size))
    fan = connected_components(graph, directed=False)[1]
    fans = np.bincount(np.unique(np.stack([vertex, fan], 1), axis=0)[:, 0])
    crowded = order[:-2][same[:-1] & same[1:]] if len(order) > 2 else order[:0]
    return np.union1d(np.flatnonzero(fans > 1), edge[crowded].reshape(-1))


def drop_pinches(vertices: np.ndarray, tets: np.ndarray, *, rounds: int = 20) -> np.ndarray | None:
    """Leave out a few tetrahedra so that the boundary becomes one clean surface.

    At a pinched vertex all but the largest group of face-connected tetrahedra go; where there is one group only
    (the outside is what is pinched), all of them.

    Returns:
        The tetrahedra kept (m', 4), or None if pinches remain after ``rounds``.
    """
    for _ in range(rounds):
        pinched = pinched_vertices(tets)
        if not len(pinched):
            return tets
        doomed = np.zeros(len(tets), bool)
        for v in pinched:
            star = np.flatnonzero((tets == v).any(axis=1))
            if doomed[star].any():
                continue  # a neighbour has just been dealt with, which may have cured this one: see next round
            group = body_of_each_tet(tets[star])
            size = np.bincount(group, weights=tet_volumes(vertices, tets[star]))
            doomed[star[group != size.argmax()] if len(size) > 1 else star] = True
        tets = tets[~doomed]
        if not len(tets):
            return None
        body = body_of_each_tet(tets)
        tets = tets[body == np.bincount(body, weights=tet_volumes(vertices, tets)).argmax()]
    return None
