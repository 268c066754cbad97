"""Nested dissection: an order of a mesh's nodes that keeps a Cholesky factor small, and its tree of dense fronts.

A set of nodes is cut in two where a plane across it crosses the fewest edges; the fewest nodes that touch all these
edges (the least vertex cover of a bipartite graph, by König's theorem from a largest matching) part the halves, and are
eliminated after both (George 1973).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, maximum_bipartite_matching

_LEAF = 12  # nodes that are not cut any further: a dense front of 36 unknowns
_LARGE = 60  # nodes above which all axes are tried: there cuts cost most


def fronts(graph: sp.csr_matrix,
           points: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], list[tuple[int, ...]]]:
    """Fronts of a graph, nodes that are eliminated together, in an order in which children come before their parents.

    Args:
        graph: symmetric (n, n), nonzero where two nodes are connected.
        points: places of the nodes (n, 3), which only guide the cuts.

    Returns:
        Of each front its nodes (p,); the later nodes that they are connected to by then (q,), in the order of
        elimination; and the numbers of its children, the fronts that are eliminated before.
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
    order = np.concatenate(own)
    rank = np.empty(count, np.int64)
    rank[order] = np.arange(count)
    boundary: list[np.ndarray] = []
    for mine, below in zip(own, children, strict=True):
        tied = [graph.indices[graph.indptr[i]:graph.indptr[i + 1]] for i in mine] + [boundary[c] for c in below]
        later = np.unique(rank[np.concatenate(tied)]) if tied else np.zeros(0, np.int64)
        boundary.append(order[later[later > rank[mine].max(initial=-1)]])
    return own, boundary, children


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
