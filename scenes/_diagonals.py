"""Better diagonals for bent hexahedra: a few vertices change their rank where a tetrahedron is too flat."""

from __future__ import annotations

import numpy as np

from vsfsim.core.hexes import split_hexes
from vsfsim.core.solid import smallest_sine


def improve_rank(vertices: np.ndarray, hexes: np.ndarray, rank: np.ndarray, *, good: float = 0.2,
                 rounds: int = 60) -> np.ndarray:
    """A ranking (n,) with which `split_hexes` gives better shaped tetrahedra.

    Each corner of the worst cell is tried at the front and at the back of the ranking. The trial that most improves the
    worst tetrahedron of the cells around its corner is kept. The search is greedy and deterministic.

    Args:
        vertices: (n, 3) [m].
        hexes: (c, 8).
        rank: (n,), distinct.
        good: sine of a dihedral angle that needs no improvement [-].
        rounds: largest number of cells tried.
    """
    rank = rank.copy()
    # The cells at each vertex: the corners are sorted by vertex, and eight corners make a cell.
    around = np.split(np.argsort(hexes, axis=None, kind="stable") // 8,
                      np.cumsum(np.bincount(hexes.ravel(), minlength=len(vertices)))[:-1])
    tets, owner = split_hexes(hexes, rank)
    score = np.full(len(hexes), np.inf)
    np.minimum.at(score, owner, smallest_sine(vertices, tets))
    given_up = np.zeros(len(hexes), bool)
    for _ in range(rounds):
        cell = int(np.where(given_up, np.inf, score).argmin())
        if score[cell] >= good or given_up[cell]:
            break
        trials = [(v, place) for v in hexes[cell] for place in (rank.min() - 1, rank.max() + 1)]
        cells = [around[v] for v, _ in trials]
        ranks = [np.where(hexes[near] == v, place, rank[hexes[near]]) for (v, place), near in zip(trials, cells)]
        # All trials share one call, because a call costs far more than a cell.
        scores = _cell_scores(vertices, hexes[np.concatenate(cells)], np.concatenate(ranks))
        scores = np.split(scores, np.cumsum([len(near) for near in cells])[:-1])
        gains = [new.min() - score[near].min() if new[near == cell][0] > score[cell] else -np.inf
                 for near, new in zip(cells, scores)]
        # The gains are rounded, so that on every machine the first of several equal gains is chosen.
        best = int(np.argmax(np.round(gains, 9)))
        if gains[best] < 1e-9:
            given_up[cell] = True
            continue
        v, place = trials[best]
        rank[v] = place
        score[cells[best]] = scores[best]
        given_up[cells[best]] = False
    return rank.argsort(kind="stable").argsort(kind="stable")


def _cell_scores(vertices: np.ndarray, hexes: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Smallest sine of a dihedral angle in each cell (c,) [-]; ``rank`` (c, 8) is that of its corners."""
    # Each cell gets vertices of its own, because split_hexes compares ranks only within a cell.
    own = np.arange(hexes.size).reshape(hexes.shape)
    tets, owner = split_hexes(own, rank.reshape(-1))
    out = np.full(len(hexes), np.inf)
    np.minimum.at(out, owner, smallest_sine(vertices[hexes.reshape(-1)], tets))
    return out
