"""A body filled with tetrahedra of a regular lattice, the same every time: isosurface stuffing.

A body-centred cubic lattice is laid over the body, its corners near the surface are moved onto it, and what still
crosses the surface is cut there (Labelle and Shewchuk 2007, "Isosurface stuffing: fast tetrahedral meshes with good
dihedral angles"). The lattice is stretched to fit the bounding box, so that a block comes out exactly, with an even
number of cells across, as `vsfsim.physics.mesh.structured.box` has. Corners, edges and the highest points of the
surface then pull the nearest vertices onto them, as far as the shape of the tetrahedra allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import elementwise
from scipy.spatial import cKDTree

from vsfsim.core.hexes import split_prisms
from vsfsim.core.solid import boundary_faces, tet_volumes
from vsfsim.physics.mesh.validity import Mover

DENSITY = 5.0
"""Tetrahedra in a volume h^3, h the element size: as many as of the cubes of edge h that a box is cut into [-]."""
CELL = (12.0 / DENSITY) ** (1 / 3)
"""Edge of a cell, which holds 12 tetrahedra, over the element size [-]."""
_NEAR_LONG, _NEAR_SHORT = 0.24999, 0.41189  # Labelle and Shewchuk, table 1: a cut nearer to a node moves the node
_ROUNDS, _FOUND = 40, 1e-9  # of the search for a cut, at most, and the level over the edge at which it ends [-]
_TIE = 4  # decimals to which fractions of edges are compared, so that a symmetric body keeps its ties
_WORST_SINE = 0.12  # smallest sine of a dihedral angle to which a pull may bring a tetrahedron
_PULL = 0.55  # of a cell's edge: how far a corner or an edge of the surface pulls

Level = Callable[[np.ndarray], np.ndarray]


def fill_lattice(level: Level, low: np.ndarray, high: np.ndarray, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """Tetrahedra inside a body.

    Args:
        level: of points (k, 3) [m], negative in the body (k,): a signed distance [m], or -1 and 1.
        low, high: corners of its bounding box (3,) [m].
        resolution: element size [m].

    Returns:
        Vertices (n, 3) [m] and positively oriented tetrahedra (m, 4); none if no node lies inside.
    """
    cell, nodes, tets = _lattice(low, high, CELL * resolution)
    value = level(nodes)
    state = np.where(value < 0.0, 1, -1).astype(np.int8)
    tets = tets[(state[tets] > 0).any(axis=1)]
    pairs = np.concatenate([tets[:, [i, j]] for i in range(4) for j in range(i + 1, 4)])
    pairs = np.unique(np.sort(pairs[state[pairs[:, 0]] != state[pairs[:, 1]]], axis=1), axis=0)
    if not len(pairs):
        return nodes[:0], tets[:0]
    # the first end of every cut edge is the inner one
    pairs = np.where((state[pairs[:, 0]] > 0)[:, None], pairs, pairs[:, ::-1])
    cut = _crossings(level, nodes[pairs])
    nodes, state, alive = _move_nodes(nodes, state, pairs, cut, cell)
    points = np.concatenate([nodes, cut[1]])
    number = {(int(a), int(b)): len(nodes) + k for k, (a, b) in enumerate(pairs) if alive[k]}
    used, kept = np.unique(_clip(points, tets[(state[tets] > 0).any(axis=1)], state, number), return_inverse=True)
    return points[used], kept.reshape(-1, 4)


def _lattice(low: np.ndarray, high: np.ndarray, edge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges of a cell (3,), nodes (n, 3) and tetrahedra (m, 4) of a lattice with one cell around the box."""
    count = np.maximum(np.ceil((high - low) / edge - 1e-6).astype(int), 1)
    count[:2] += count[:2] % 2
    cell = (high - low) / count
    shape = count + 3  # nodes at corners, with a cell on each side
    axes = [low[a] + cell[a] * (np.arange(shape[a]) - 1) for a in range(3)]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    middle = shape - 1
    centres = np.stack(np.meshgrid(*(x[:-1] + 0.5 * c for x, c in zip(axes, cell, strict=True)), indexing="ij"),
                       axis=-1).reshape(-1, 3)
    corner = np.arange(len(corners)).reshape(shape)
    centre = len(corners) + np.arange(len(centres)).reshape(middle)
    tets = []
    for axis in range(3):
        # four tetrahedra about the line between the centres of two cells with a common face
        one, two = (np.moveaxis(centre, axis, 0)[part].reshape(-1) for part in (slice(None, -1), slice(1, None)))
        face = np.moveaxis(corner, axis, 0)[1:-1]
        across, along = face.shape[1] - 1, face.shape[2] - 1
        ring = [face[:, i:across + i, j:along + j].reshape(-1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        tets += [np.stack([one, two, ring[k], ring[(k + 1) % 4]], axis=1) for k in range(4)]
    nodes = np.concatenate([corners, centres])
    out = np.concatenate(tets)
    flip = tet_volumes(nodes, out) < 0.0
    out[flip] = out[flip][:, [1, 0, 2, 3]]
    return cell, nodes, out


def _crossings(level: Level, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where edges, of ``ends`` (k, 2, 3), leave the body: part of the way from the inner end (k,) and place (k, 3)."""
    inner, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    least = _FOUND * float(np.linalg.norm(way, axis=1).max())
    part = elementwise.find_root(lambda part, rows: level(inner[rows] + part[:, None] * way[rows]), (0.0, 1.0),
                                 args=(np.arange(len(ends)),), maxiter=_ROUNDS,
                                 tolerances={"fatol": least, "xatol": 0.1 * _FOUND}).x
    return part, inner + part[:, None] * way


def _move_nodes(nodes: np.ndarray, state: np.ndarray, pairs: np.ndarray, cut: tuple[np.ndarray, np.ndarray],
                cell: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes near a cut go to it, the nearest first: nodes, states with 0 on the surface, and the cuts that remain."""
    part, place = cut
    along = np.abs(nodes[pairs[:, 1]] - nodes[pairs[:, 0]])
    near = np.where((along > 0.25 * cell).sum(axis=1) == 1, _NEAR_LONG, _NEAR_SHORT)
    ends = np.concatenate([pairs[:, 0], pairs[:, 1]])
    away = np.concatenate([part, 1.0 - part])
    reach = np.linalg.norm(nodes[pairs[:, 1]] - nodes[pairs[:, 0]], axis=1)
    length = np.concatenate([away[:len(part)] * reach, away[len(part):] * reach])
    close = np.flatnonzero(away < np.concatenate([near, near]))
    scale = float(cell.max())
    order = close[np.lexsort((close, ends[close], np.round(length[close] / scale, _TIE)))]
    nodes, state, alive = nodes.copy(), state.copy(), np.ones(len(pairs), bool)
    touching = np.split(np.argsort(ends, kind="stable") % len(pairs),
                        np.cumsum(np.bincount(ends, minlength=len(nodes)))[:-1])
    for row in order.tolist():
        edge, node = row % len(pairs), int(ends[row])
        if alive[edge] and state[node] != 0:
            nodes[node], state[node] = place[edge], 0
            alive[touching[node]] = False
    return nodes, state, alive


def _clip(points: np.ndarray, tets: np.ndarray, state: np.ndarray, number: dict[tuple[int, int], int]) -> np.ndarray:
    """What is inside of each tetrahedron, cut into tetrahedra."""
    signs = state[tets]
    minus = (signs < 0).sum(axis=1)
    out = [tets[minus == 0]]
    prisms: list[list[int]] = []
    single: list[list[int]] = []
    for tet, sign in zip(tets[minus > 0].tolist(), signs[minus > 0].tolist(), strict=True):
        inner = [v for v, s in zip(tet, sign, strict=True) if s > 0]
        outer = [v for v, s in zip(tet, sign, strict=True) if s < 0]
        on = [v for v, s in zip(tet, sign, strict=True) if s == 0]
        at = [[number[(a, b)] for b in outer] for a in inner]
        if len(inner) == 1:
            single.append([inner[0], *at[0], *on])
        elif len(inner) == 3:
            prisms.append([*inner, *(row[0] for row in at)])
        elif len(outer) == 2:
            prisms.append([inner[0], *at[0], inner[1], *at[1]])
        else:  # a pyramid over two inner nodes and two cuts; of a quadrilateral the lowest number has the diagonal
            (a, b), (c, d), tip = inner, (at[0][0], at[1][0]), on[0]
            single += [[a, b, d, tip], [a, d, c, tip]] if a < b else [[b, a, c, tip], [b, c, d, tip]]
    out.append(np.array(single, np.int64).reshape(-1, 4))
    if prisms:
        out.append(split_prisms(np.array(prisms), np.arange(len(points)))[0])
    every = np.concatenate(out)
    flip = tet_volumes(points, every) < 0.0
    every[flip] = every[flip][:, [1, 0, 2, 3]]
    return every


def pull_to_features(vertices: np.ndarray, tets: np.ndarray, corners: np.ndarray, edges: np.ndarray,
                     reach: float) -> np.ndarray:
    """Vertices of the boundary moved onto corners and edges of the surface, nearest first.

    Args:
        vertices: of the filling (n, 3) [m].
        tets: its tetrahedra (m, 4).
        corners: points (k, 3) [m], each of which takes one vertex.
        edges: ends of the surface's sharp edges (e, 2, 3) [m].
        reach: edge of a cell [m].

    Returns:
        The vertices (n, 3) [m]; no tetrahedron has become worse than `_WORST_SINE`, or than it was.
    """
    mover, rim = Mover(vertices, tets, _WORST_SINE), np.unique(boundary_faces(tets)[0])
    vertices = mover.vertices
    if len(corners):
        away, near = cKDTree(vertices[rim]).query(corners, k=min(8, len(rim)), distance_upper_bound=_PULL * reach)
        away, near = away.reshape(len(corners), -1), near.reshape(len(corners), -1)
        for c in np.lexsort((np.arange(len(corners)), np.round(away[:, 0] / reach, _TIE))):
            for at in np.lexsort((near[c], np.round(away[c] / reach, _TIE))):
                d, k = away[c, at], near[c, at]
                if np.isfinite(d) and mover.move(int(rim[k]), corners[c]):
                    break
    if len(edges):
        steps = [max(1, math.ceil(float(np.linalg.norm(b - a)) / (0.02 * reach))) for a, b in edges]
        dense = np.concatenate([a + np.linspace(0.0, 1.0, n + 1)[:, None] * (b - a)
                                for (a, b), n in zip(edges, steps, strict=True)])
        away, near = cKDTree(dense).query(vertices[rim], distance_upper_bound=_PULL * reach)
        for k in np.lexsort((rim, np.round(away / reach, _TIE))):
            if np.isfinite(away[k]):
                mover.move(int(rim[k]), dense[near[k]])
    return vertices
