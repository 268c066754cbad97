"""Whether tetrahedra make a body that a solver can use: none folded over or flat, no part that nothing holds; bodies of
a mesh, and boundaries that touch themselves at a point or an edge.

Meshes of this package are valid by construction; a user's family, or a `Solid` made by hand, may not be.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vsfsim.core.errors import MeshError, SceneError
from vsfsim.core.solid import TET_FACES, Solid, boundary_faces, smallest_sine, tet_volumes

# Six volumes over the cube of the longest edge: a regular tetrahedron has 0.7, one whose dihedral angles come down to 1
# degree about 0.01. Below this the gradients of the shape functions have lost half their digits.
FLAT = 1e-7


def sound(solid: Solid, where: str) -> tuple[Solid, np.ndarray]:
    """Turn inverted tetrahedra round, leave out unused vertices, refuse what cannot be mended.

    Args:
        solid: any tetrahedra.
        where: file and section, for messages.

    Returns:
        The solid, with a note for what was done, and which tetrahedra had their first two corners swapped (m,).

    Raises:
        MeshError: no tetrahedra, coordinates that are not finite, flat tetrahedra, or tetrahedra that overlap their
        neighbours.
    """
    vertices, tets = np.asarray(solid.vertices, float), np.asarray(solid.tets, np.int64)
    if not len(tets):
        raise MeshError(f"{where}: the body has no tetrahedra.")
    if tets.min() < 0 or tets.max() >= len(vertices) or not np.isfinite(vertices[tets]).all():
        raise MeshError(f"{where}: the body's tetrahedra name vertices that do not exist or are not finite numbers; "
                        f"mesh it again.")
    corner = vertices[tets]
    longest = np.linalg.norm(corner[:, (0, 0, 0, 1, 1, 2)] - corner[:, (1, 2, 3, 2, 3, 3)], axis=-1).max(axis=1)
    volume = tet_volumes(vertices, tets)
    flat = np.flatnonzero(6.0 * np.abs(volume) <= FLAT * longest**3)
    if len(flat):
        raise MeshError(f"{where}: {len(flat)} of {len(tets)} tetrahedra are flat, the first at "
                        f"{_place(corner[flat[0]])}; mesh the body again, or merge their corners.")
    turned = volume < 0.0
    notes = solid.notes
    if turned.any():
        tets = np.where(turned[:, None], tets[:, [1, 0, 2, 3]], tets)
        notes = (*notes, f"{int(turned.sum())} of {len(tets)} tetrahedra were inside out; turned them round.")
    doubled = _overlapping(tets)
    if len(doubled):
        raise MeshError(f"{where}: {len(doubled)} of {len(tets)} tetrahedra are folded over a neighbour or listed "
                        f"twice, the first at {_place(corner[doubled[0]])}: a vertex has passed through the face "
                        f"opposite. Mesh the body again.")
    used, renumbered = np.unique(tets, return_inverse=True)
    if len(used) == len(vertices) and not turned.any():
        return solid, turned
    if len(used) < len(vertices):
        notes = (*notes, f"Left out {len(vertices) - len(used)} vertices that no tetrahedron uses.")
    return dataclasses.replace(solid, vertices=vertices[used], tets=renumbered.reshape(-1, 4), notes=notes), turned


def refuse_loose(points: np.ndarray, nodes: np.ndarray, held: np.ndarray, where: str) -> None:
    """Refuse a body of which a part could move freely: the stiffness would be singular.

    Parts are joined through faces; at a common vertex or edge one can turn against the other.

    Args:
        points: nodes (n, 3) [m].
        nodes: of each tetrahedron, corners first (m, 4 or more).
        held: mask of the supported nodes (n,).
        where: file, section and supports, for messages.

    Raises:
        SceneError: a part whose held nodes lie on a line, or that has none.
    """
    body = body_of_each_tet(np.asarray(nodes[:, :4], np.int64))
    for part in range(body.max() + 1):
        mine = np.unique(nodes[body == part])
        grip = points[mine[held[mine]]]
        if len(grip) < 3 or np.linalg.matrix_rank(grip - grip.mean(axis=0),
                                                  tol=1e-6 * float(np.ptp(points, axis=0).max())) < 2:
            low, high = (f"[{', '.join(f'{v:.4g}' for v in corner)}]" for corner in (
                points[mine].min(axis=0), points[mine].max(axis=0)))
            one = f"one of {body.max() + 1} parts that no face joins" if body.any() else "the body"
            raise SceneError(f"{where} holds {len(grip)} of {len(mine)} nodes of {one}, from {low} to {high} m in its "
                             f"own frame, on a line at most: it could turn. Give a box [x0, y0, z0, x1, y1, z1] that "
                             f"holds a face of it, join the parts, or turn the body in its file.")


def _overlapping(tets: np.ndarray) -> np.ndarray:
    """Tetrahedra (k,) that share a face with another from the same side of it, or with two others."""
    faces = tets[:, TET_FACES].reshape(-1, 3)
    # with the least vertex first, the two senses of a face differ in the order of the other two
    least = faces.argmin(axis=1)[:, None]
    wound = np.take_along_axis(faces, (least + np.arange(3)) % 3, axis=1)
    _, which, count = np.unique(wound, axis=0, return_inverse=True, return_counts=True)
    return np.unique(np.flatnonzero(count[which.ravel()] > 1) // 4)


def _place(points: np.ndarray) -> str:
    return f"[{', '.join(f'{v:.4g}' for v in np.round(points.mean(axis=0), 9) + 0.0)}] m"


def joined(keys: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Number of the group of each of ``count`` things (count,), which equal rows of ``keys`` (k, c) join.

    Args:
        owner: the thing that each row belongs to (k,).
    """
    order = np.lexsort(keys.T)
    number = np.empty(len(keys), np.int64)
    number[order] = np.cumsum(np.r_[0, (keys[order][1:] != keys[order][:-1]).any(axis=1)][:len(keys)])
    size = count + len(keys)
    graph = coo_matrix((np.ones(len(keys)), (owner, count + number)), shape=(size, size))
    return connected_components(graph, directed=False)[1][:count]


def body_of_each_tet(tets: np.ndarray) -> np.ndarray:
    """Number of the body each tetrahedron belongs to (m,); bodies are joined through faces."""
    return joined(np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1), np.repeat(np.arange(len(tets)), 4), len(tets))


def pinched_vertices(tets: np.ndarray) -> np.ndarray:
    """Vertices where the boundary is not one sheet: its faces there form more than one fan (k,).

    The ends of an edge with four boundary faces are among them.
    """
    faces, _ = boundary_faces(tets)
    # A corner (face f at vertex v) is next to the corner of v in the face across each edge of f at v.
    vertex = faces.reshape(-1)
    edge = np.concatenate([np.stack([vertex, np.roll(faces, shift, axis=1).reshape(-1)], axis=1) for shift in (-1, 1)])
    fan = joined(edge, np.tile(np.arange(faces.size), 2), faces.size)
    fans = np.bincount(np.unique(np.stack([vertex, fan], 1), axis=0)[:, 0])
    ends, count = np.unique(edge, axis=0, return_counts=True)
    return np.union1d(np.flatnonzero(fans > 1), ends[count > 2].reshape(-1))


class Mover:
    """Moves vertices (n, 3) of tetrahedra (m, 4) once each, none of them to the harm of a tetrahedron.

    Args:
        worst: smallest sine of a dihedral angle to which a move may bring a tetrahedron [-].
    """

    vertices: np.ndarray
    """Where they are now (n, 3) [m]."""
    taken: np.ndarray
    """Whether each was moved (n,) bool."""
    around: list[np.ndarray]
    """Numbers of the tetrahedra at each vertex (n,)."""

    def __init__(self, vertices: np.ndarray, tets: np.ndarray, worst: float):
        self.vertices, self._tets, self._worst = vertices.copy(), tets, worst
        self.taken = np.zeros(len(vertices), bool)
        count = np.bincount(tets.ravel(), minlength=len(vertices))
        self.around = np.split(np.argsort(tets.ravel(), kind="stable") // tets.shape[1], np.cumsum(count)[:-1])

    def move(self, v: int, target: np.ndarray) -> bool:
        """Move a vertex, unless it was moved or a tetrahedron there became worse than it may, and than it was."""
        if self.taken[v]:
            return False
        mine = self._tets[self.around[v]]
        before, old = float(smallest_sine(self.vertices, mine).min()), self.vertices[v].copy()
        self.vertices[v] = target
        self.taken[v] = smallest_sine(self.vertices, mine).min() >= min(self._worst, before)
        if not self.taken[v]:
            self.vertices[v] = old
        return bool(self.taken[v])


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
