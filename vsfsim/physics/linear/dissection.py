"""Nested dissection: an order of a mesh's nodes that keeps a Cholesky factor small, and its tree of dense fronts.

A set of nodes is cut in two where a plane across it crosses the fewest edges; the fewest nodes that touch all these
edges (the least vertex cover of a bipartite graph, by König's theorem from a largest matching) part the halves, and are
eliminated after both (George 1973).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, maximum_bipartite_matching

_LEAF = 12  # nodes that are not cut any further: a dense front of 36 unknowns
_LARGE = 60  # nodes above which all axes are tried: there cuts cost most


@dataclass(frozen=True)
class Front:
    """Nodes that are eliminated together."""

    own: np.ndarray
    """The nodes (p,)."""
    boundary: np.ndarray
    """Later nodes that they are connected to by then (q,), in the order of elimination."""
    children: tuple[int, ...]
    """Numbers of the fronts that are eliminated before."""


def fronts(graph: sp.csr_matrix, points: np.ndarray) -> list[Front]:
    """Fronts of a graph in an order in which children come before their parents.

    Args:
        graph: symmetric (n, n), nonzero where two nodes are connected.
        points: places of the nodes (n, 3), which only guide the cuts.
    """
    graph = graph.tocsr()
    count = graph.shape[0]
    own: list[np.ndarray] = []
    children: list[tuple[int, ...]] = []

    def cut(nodes: np.ndarray) -> int:
        """Cut ``nodes``; returns the number of the front of theirs that is eliminated last."""
        below: tuple[int, ...] = ()
        if len(nodes) > _LEAF:
            separator, parts = _halves(graph, points, nodes)
            below = tuple(cut(part) for part in parts if len(part))
            nodes = separator
        own.append(nodes)
        children.append(below)
        return len(own) - 1

    cut(np.arange(count))
    rank = np.empty(count, np.int64)
    rank[np.concatenate(own)] = np.arange(count)
    out: list[Front] = []
    for mine, below in zip(own, children, strict=True):
        last = rank[mine].max() if len(mine) else -1
        tied = [graph.indices[graph.indptr[i]:graph.indptr[i + 1]] for i in mine] + [out[c].boundary for c in below]
        later = np.unique(rank[np.concatenate(tied)]) if tied else np.zeros(0, np.int64)
        mine_ranks = np.sort(rank[mine])
        later = np.setdiff1d(later[later > last] if len(mine) else later, mine_ranks)
        order = np.concatenate(own)
        out.append(Front(mine, order[later], below))
    return out


def _halves(graph: sp.csr_matrix, points: np.ndarray,
            nodes: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """The separator of ``nodes`` and the two remaining parts."""
    part = graph[nodes][:, nodes].tocoo()
    at = points[nodes]
    extent = np.ptp(at, axis=0)
    axes = np.argsort(-extent, kind="stable") if len(nodes) > _LARGE else [int(extent.argmax())]
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for axis in axes:
        order = np.argsort(at[:, axis], kind="stable")
        left = np.zeros(len(nodes), bool)
        left[order[:len(nodes) // 2]] = True
        separator = vertex_cover(part, left)
        sizes = (left & ~separator).sum(), (~left & ~separator).sum()
        # the front of the separator costs its cube, and the halves are no use if one of them is nearly all
        cost = separator.sum() * (1.0 + 4.0 * max(0.0, max(sizes) / len(nodes) - 0.6))
        if best is None or cost < best[0]:
            best = (cost, separator, left)
    _, separator, left = best
    return nodes[separator], (nodes[left & ~separator], nodes[~left & ~separator])


def vertex_cover(part: sp.coo_matrix, left: np.ndarray) -> np.ndarray:
    """The smallest set of nodes (n,) bool that touches every edge between the two sides.

    Args:
        part: adjacency of the nodes (n, n), symmetric.
        left: which nodes are on the one side (n,) bool.
    """
    across = left[part.row] & ~left[part.col]
    row, col = part.row[across], part.col[across]
    out = np.zeros(len(left), bool)
    if not len(row):
        return out
    here, row = np.unique(row, return_inverse=True)
    there, col = np.unique(col, return_inverse=True)
    edges = sp.csr_matrix((np.ones(len(row)), (row, col)), shape=(len(here), len(there)))
    partner = maximum_bipartite_matching(edges, perm_type="column")  # of each row a column, -1 none
    matched, alone = np.flatnonzero(partner >= 0), np.flatnonzero(partner < 0)
    # König: from the rows without a partner, which a source leads to, along any edge to a column, and back along its
    # matching
    n, source = len(here), len(here) + len(there)
    leaves = np.concatenate([row, n + partner[matched], np.full(len(alone), source)])
    enters = np.concatenate([n + col, matched, alone])
    ways = sp.csr_matrix((np.ones(len(leaves)), (leaves, enters)), shape=(source + 1, source + 1))
    reached = np.zeros(source + 1, bool)
    reached[breadth_first_order(ways, source, return_predecessors=False)] = True
    out[here[~reached[:n]]] = True
    out[there[reached[n:source]]] = True
    return out
