"""Sparse positive definite matrices by dense fronts: factor, determinant, solutions, and the diagonal of the inverse.

A touch moves few of an object's particles, so the matrix of the particles that touches connect is mostly zero, and in a
good order its Cholesky factor is, too. The order is SuperLU's minimum degree; columns of the factor with nearly the
same rows are eliminated together, as one dense *front* of its own unknowns and those that they couple to (multifrontal
elimination). The diagonal of the inverse comes from the same fronts in the reverse order (selected inversion, Takahashi
et al. 1973), without the rest of the inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import splu

_SMALL = 24
"""Unknowns up to which a front takes in one that it couples to, however many zeros that stores."""
_ZEROS = 0.15
"""Share of stored zeros up to which larger fronts are joined."""


@dataclass(frozen=True)
class _Front:
    """Unknowns that are eliminated together."""

    own: np.ndarray
    """Which (e,) int, in the order of the matrix."""
    border: np.ndarray
    """Unknowns of later fronts to which they couple (u,) int."""
    above: int
    """Number of the front that has the first of them, -1 for none."""
    place: np.ndarray
    """Where the border is in that front: index into its own and border (u,) int."""
    entries: np.ndarray
    """Stored entries of the matrix that belong here (q,) int."""
    spots: np.ndarray
    """Where they go in the front's columns (q,) int, in Fortran's order."""


@dataclass(frozen=True)
class Fronts:
    """The order of elimination of a sparse symmetric matrix (k, k), whose values may change."""

    fronts: tuple[_Front, ...]
    """In the order of elimination."""
    size: int
    """k."""
    row: np.ndarray
    """Rows of the stored entries (q,) int."""
    column: np.ndarray
    """Their columns (q,) int."""
    kept: np.ndarray
    """Which of the matrix's entries they are, in the order of its ``data`` (q,) int."""
    work: float
    """Multiplications of a factor [-]; a dense one takes k^3 / 6."""

    @classmethod
    def of(cls, matrix: sparse.csr_matrix) -> Fronts:
        """The order for the places of the entries of ``matrix`` (k, k), which are symmetric."""
        size = matrix.shape[0]
        pattern = sparse.csc_matrix((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=matrix.shape)
        groups = _joined(*_eliminated(pattern))
        where = np.empty(size, np.int64)  # an unknown's turn
        where[np.concatenate([own for own, _ in groups])] = np.arange(size)
        front_of = np.empty(size, np.int64)
        for number, (own, _) in enumerate(groups):
            front_of[own] = number
        stored = matrix.tocoo()
        row, column = stored.row.astype(np.int64), stored.col.astype(np.int64)
        kept = np.flatnonzero(where[row] >= where[column])
        row, column = row[kept], column[kept]
        sort = np.argsort(front_of[column], kind="stable")
        cuts = np.searchsorted(front_of[column[sort]], np.arange(len(groups) + 1))
        fronts, index = [], np.full(size, -1, np.int64)
        members = [np.concatenate([own, border[np.argsort(where[border])]]) for own, border in groups]
        for number, ((own, border), mine) in enumerate(zip(groups, members, strict=True)):
            index[mine] = np.arange(len(mine))
            entries = sort[cuts[number]:cuts[number + 1]]
            spots = index[row[entries]] + len(mine) * index[column[entries]]
            above, place = -1, np.zeros(0, np.int64)
            if len(border):
                above = int(front_of[mine[len(own)]])
                index[members[above]] = np.arange(len(members[above]))
                place = index[mine[len(own):]]
            fronts.append(_Front(own, mine[len(own):], above, place, entries, spots))
        return cls(tuple(fronts), size, row, column, kept, _work(groups))

    def factor(self, values: np.ndarray) -> Factor:
        """Factor the matrix with ``values`` (q,) of the entries `row`, `column`, plus the identity."""
        parts: list[tuple[np.ndarray, np.ndarray]] = []
        waiting: list[list[tuple[np.ndarray, np.ndarray]]] = [[] for _ in self.fronts]
        log_det = 0.0
        for number, front in enumerate(self.fronts):
            own, count = len(front.own), len(front.own) + len(front.border)
            dense = np.zeros((count, count), order="F")
            flat = dense.reshape(-1, order="F")
            flat[front.spots] = values[front.entries]
            flat[:own * count + own:count + 1][:own] += 1.0
            for place, update in waiting[number]:
                dense[np.ix_(place, place)] += update
            waiting[number] = []
            lower, info = lapack.dpotrf(dense[:own, :own], lower=1, clean=1)
            if info:
                raise np.linalg.LinAlgError("the matrix is not positive definite")
            log_det += 2.0 * float(np.log(lower.diagonal()).sum())
            below = np.zeros((0, own))
            if count > own:
                below = blas.dtrsm(1.0, lower, dense[own:, :own], side=1, lower=1, trans_a=1)
                update = blas.dsyrk(-1.0, below, beta=1.0, c=dense[own:, own:], lower=1)
                waiting[front.above].append((front.place, update))
            parts.append((lower, below))
        return Factor(self, tuple(parts), log_det)


@dataclass(frozen=True)
class Factor:
    """Of a matrix, by fronts."""

    order: Fronts
    """The order of elimination."""
    parts: tuple[tuple[np.ndarray, np.ndarray], ...]
    """Of each front the factor of its own unknowns (e, e) and the rows below it (u, e)."""
    log_det: float
    """Logarithm of the matrix's determinant [-]."""

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The solutions (k, c) for ``right`` (k, c)."""
        out = np.array(right, np.float64)
        for front, (lower, below) in zip(self.order.fronts, self.parts, strict=True):
            mine = blas.dtrsm(1.0, lower, out[front.own], lower=1)
            out[front.own] = mine
            if len(front.border):
                out[front.border] -= below @ mine
        for front, (lower, below) in zip(reversed(self.order.fronts), reversed(self.parts), strict=True):
            mine = out[front.own] - below.T @ out[front.border] if len(front.border) else out[front.own]
            out[front.own] = blas.dtrsm(1.0, lower, mine, lower=1, trans_a=1)
        return out

    def inverse_diagonal(self) -> np.ndarray:
        """Diagonal of the inverse (k,)."""
        out = np.empty(self.order.size)
        known: dict[int, np.ndarray] = {}  # the inverse among the unknowns of each front that others need
        needed = {front.above for front in self.order.fronts}
        for number in range(len(self.parts) - 1, -1, -1):
            front, (lower, below) = self.order.fronts[number], self.parts[number]
            inverse = lapack.dtrtri(lower, lower=1)[0]
            own = len(front.own)
            if number not in needed:  # only its diagonal is asked for
                diagonal = np.einsum("ij,ij->j", inverse, inverse)
                if len(front.border):
                    around = known[front.above][np.ix_(front.place, front.place)]
                    pull = below @ inverse
                    diagonal += np.einsum("ij,ij->j", pull, around @ pull)
                out[front.own] = diagonal
                continue
            full = np.empty((own + len(front.border),) * 2)
            full[:own, :own] = inverse.T @ inverse
            if len(front.border):
                around = known[front.above][np.ix_(front.place, front.place)]
                pull = below @ inverse
                moved = around @ pull
                full[:own, :own] += pull.T @ moved
                full[own:, :own], full[:own, own:], full[own:, own:] = -moved, -moved.T, around
            out[front.own] = full.diagonal()[:own]
            known[number] = full
        return out


def _eliminated(pattern: sparse.csc_matrix) -> tuple[np.ndarray, sparse.csc_matrix]:
    """An order of elimination of little fill (k,), and the lower factor's pattern in that order (k, k), whose column j
    holds the later unknowns that unknown j then couples to, besides itself."""
    # In an M-matrix, off-diagonal entries below 0 and a dominant diagonal, fill is below 0 and cannot cancel.
    size = pattern.shape[0]
    given = sparse.csc_matrix((size + 1.0) * sparse.identity(size, format="csc") - pattern)
    factor = splu(given, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    lower = sparse.csc_matrix(factor.L)
    lower.sort_indices()
    return np.argsort(factor.perm_c), lower


def _joined(order: np.ndarray, lower: sparse.csc_matrix) -> list[tuple[np.ndarray, np.ndarray]]:
    """Fronts of several unknowns, in an order of elimination: their own, and those of their border in their turn.

    A front joins the one that has the first unknown of its border, if this stores few zeros.
    """
    size = len(order)
    start, below = lower.indptr[:-1] + 1, lower.indices  # without the diagonal
    rows = np.diff(lower.indptr) - 1
    above = [int(below[k]) if count else -1 for k, count in zip(start, rows)]
    stored = [count + 1.0 for count in rows.tolist()]  # entries of the factor that need not be zero
    joined_to, own = list(range(size)), [[k] for k in range(size)]

    def front(k: int) -> int:
        while joined_to[k] != k:
            joined_to[k] = joined_to[joined_to[k]]
            k = joined_to[k]
        return k

    border = rows.tolist()
    for k in range(size):  # before the fronts above it
        if above[k] < 0:
            continue
        up = front(above[k])
        count = len(own[k]) + len(own[up])
        entries = count * (count + 1) / 2 + count * border[up]
        if count <= _SMALL or entries - stored[k] - stored[up] <= _ZEROS * entries:
            own[up], joined_to[k] = own[k] + own[up], up
            stored[up] += stored[k]
    return [(order[own[k]], order[below[start[k]:lower.indptr[k + 1]]])
            for k in range(size) if joined_to[k] == k]


def _work(groups: list[tuple[np.ndarray, np.ndarray]]) -> float:
    own = np.array([len(g) for g, _ in groups], float)
    rows = np.array([len(b) for _, b in groups], float)
    return float((own**3 / 6 + own**2 * rows / 2 + own * rows**2 / 2).sum())
