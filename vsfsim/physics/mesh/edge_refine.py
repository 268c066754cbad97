"""Tetrahedra divided where the edges, corners and rims of a probe will meet an object.

The pressure under a flat punch is singular along its edge, so that its force is too large by about 0.15 h / a on
cells of edge h under a punch of half-width a, however the contact is sampled. Only the elements along the edge matter.
They are bisected at their longest edges until they are small enough, and grow with the distance from there:

    longest edge of a tetrahedron <= size + GROWTH x distance to the nearest place of an edge

An edge is divided in all tetrahedra around it, longest first, which keeps the mesh conforming, and a tetrahedron is
divided at its longest edge before any other, which keeps its shape (Rivara 1984, Int. J. Numer. Meth. Eng. 20).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.physics.mesh.quadratic import edges_of, round_middles
from vsfsim.physics.mesh.surface_distance import crossings

GROWTH = 0.8
"""Growth of the longest edge of a tetrahedron with the distance [-]."""
# tetrahedra that there may be, here or with layers at supports: so many times those before, and so many more
MOST_TETS = (2, 12_000)
_PAIRS = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
_PASSES = 60  # rounds of division; three halve an edge
_FOLDED = 0.2  # least volume of a tetrahedron whose new corners lie on a round surface, over that without
_LONGEST = 1.3  # longest edge of a tetrahedron over the size asked for: a cube's five have its edge and its diagonal


@dataclass(frozen=True)
class EdgePath:
    """The way of points on the edges, corners and rims of bodies that move."""

    places: np.ndarray
    """In the object's frame, from outside it (T, k, 3) [m]."""
    half: np.ndarray
    """Half-width of the body of each (k,) [m]."""

    def meets(self, solid: Solid) -> tuple[np.ndarray, np.ndarray]:
        """Where the points first pass through the surface of an object at rest (j, 3) [m], and which they are (j,)."""
        faces = solid.surface()[0]
        out: dict[int, np.ndarray] = {}
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        for start, stop in pairwise(self.places):
            near = ((np.minimum(start, stop) <= high) & (np.maximum(start, stop) >= low)).all(axis=1)
            for k in np.flatnonzero(near).tolist():
                way = stop[k] - start[k]
                if k in out or not way.any():
                    continue
                t = crossings(start[None, k], way[None], solid.vertices[faces])[0]
                hit = (t >= -1e-6) & (t <= 1.0)
                if hit.any():
                    out[k] = start[k] + t[hit].min() * way
        which = np.array(sorted(out), int)
        return np.array([out[k] for k in which.tolist()]).reshape(-1, 3), which


def refine_near(solid: Solid, edges: EdgePath, part: float) -> tuple[Solid, float]:
    """Divide the tetrahedra where edges meet a body.

    Args:
        solid: the body.
        edges: the way of the edges; a body without any is returned as it is.
        part: size of the elements along an edge over the half-width of its body [-].

    Returns:
        The body, and the size along the edges that was taken in place of ``part`` so that there are not too many
        elements [-].
    """
    places, which = edges.meets(solid)
    if not len(places):
        return solid, part
    near, most = cKDTree(places), MOST_TETS[0] * len(solid.tets) + MOST_TETS[1]
    while True:
        divided = _divide(solid, near, _LONGEST * part * edges.half[which], most)
        if len(divided.tets) <= most:
            return divided, part
        part *= 1.25


def _divide(solid: Solid, near: cKDTree, size: np.ndarray, most: int) -> Solid:
    """The solid with elements of ``size`` (k,) [m] at the places of ``near``."""
    vertices, tets, parent = solid.vertices, solid.tets, np.arange(len(solid.tets))
    for _ in range(_PASSES):
        ends, edge, rank = _edges(vertices, tets)
        longest = edge[np.arange(len(tets)), rank[edge].argmax(axis=1)]
        length = np.linalg.norm(vertices[ends[longest, 0]] - vertices[ends[longest, 1]], axis=1)
        suspect = np.flatnonzero(length > size.min())
        if not len(suspect):  # fine enough everywhere
            break
        corner = vertices[tets[suspect]]
        # corners, the middle, and that of the longest edge: a large tetrahedron may contain a place of an edge
        probe = np.concatenate([corner, corner.mean(axis=1)[:, None],
                                vertices[ends[longest[suspect]]].mean(axis=1)[:, None]], axis=1)
        away, place = (v.reshape(len(suspect), -1) for v in near.query(probe.reshape(-1, 3)))
        wanted = suspect[length[suspect] > (size[place] + GROWTH * away).min(axis=1)]
        if not len(wanted) or len(tets) > most:
            break
        divided = np.zeros(len(ends), bool)
        divided[longest[wanted]] = True
        while True:  # a tetrahedron whose edge is divided is divided at its longest edge, too
            more = longest[divided[edge].any(axis=1)]
            if divided[more].all():
                break
            divided[more] = True
        middle = np.full(len(ends), -1)
        middle[divided] = len(vertices) + np.arange(divided.sum())
        bent = round_middles(dataclasses.replace(solid, vertices=vertices, tets=tets), ends[divided])
        straight = np.concatenate([vertices, vertices[ends[divided]].mean(axis=1)])
        tets, parent = _bisect(tets, parent, edge, rank, middle)
        vertices = straight.copy()
        vertices[-len(bent):] += bent
        while (folded := tet_volumes(vertices, tets) < _FOLDED * tet_volumes(straight, tets)).any():
            vertices[tets[folded]] = straight[tets[folded]]
    return dataclasses.replace(solid, vertices=vertices, tets=tets, region=np.asarray(solid.region)[parent])


def _edges(vertices: np.ndarray, tets: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of all edges (e, 2), the edges of each tetrahedron (m, 6), and the rank of each edge by its length (e,)."""
    ends, edge = edges_of(tets, _PAIRS)
    length = np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1)
    # Equal lengths tie by the distances of their middles from the middle of the box, so that the mesh of a box stays
    # its own mirror image; rounded, so that they do so on every machine.
    middle = np.abs(vertices[ends].mean(axis=1) - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
    keys = np.round(np.column_stack([-middle, length]) / length.max(), 9)
    rank = np.empty(len(ends), np.int64)
    rank[np.lexsort((np.arange(len(ends)), *keys.T))] = np.arange(len(ends))
    return ends, edge, rank


def _bisect(tets: np.ndarray, parent: np.ndarray, edge: np.ndarray, rank: np.ndarray,
            middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide tetrahedra at all their edges that have a ``middle`` (e,), the longest first; -1 is no edge of before."""
    done, origin = [], []
    while len(tets):
        order = np.where((edge >= 0) & (middle[edge] >= 0), rank[edge], -1)
        at = order.argmax(axis=1)
        rows = np.arange(len(tets))
        open_ = order[rows, at] >= 0
        done.append(tets[~open_])
        origin.append(parent[~open_])
        tets, parent, edge, at = tets[open_], parent[open_], edge[open_], at[open_]
        rows = np.arange(len(tets))
        new = middle[edge[rows, at]]
        halves, edges = [], []
        for end in (0, 1):  # the corner that the middle takes the place of
            gone = _PAIRS[at, end]
            half, own = tets.copy(), edge.copy()
            half[rows, gone] = new
            # the edges of that corner are new ones; what is left of the divided edge is not divided again
            own[(_PAIRS[None] == gone[:, None, None]).any(axis=2)] = -1
            halves.append(half)
            edges.append(own)
        tets, edge, parent = np.concatenate(halves), np.concatenate(edges), np.concatenate([parent, parent])
    return np.concatenate(done), np.concatenate(origin)
