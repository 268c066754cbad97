"""The elimination of a multifrontal factor: the order of a mesh, made once, and the fronts of a matrix on it.

The updates of a front's children lie on a stack, and are added to it natively: with sparse matrices and arrays of their
own the bookkeeping took two thirds of the time.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lapack

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear.dissection import fronts

UNIT = 32767.0
"""The integer that represents 1 in a stored block."""
_PAD = 16  # rows are padded to a multiple of this: whole vectors of the processor
_STRIP = 192  # rows of an update that are multiplied together
NOT_DEFINITE = ("The stiffness of the body at rest is not positive definite: a part of it can move freely, or elements "
                "have no volume. Hold the body by more of its nodes, or mend the mesh.")
"""What `MeshError` says of such a matrix."""
_LOOSE = 1e15  # a pivot below this fraction of its diagonal entry (inverted) is treated as zero: it is rounding error


@dataclass(frozen=True)
class Factor:
    """The stored blocks of all fronts."""

    blocks: np.ndarray
    """Q (p rows) and, after it, P^T (p rows) of every front, one after the other (e,), in units of 1 / `UNIT` [-]."""
    pivots: np.ndarray
    """d of the padded pivots of all fronts (v,) [sqrt(m/N)]."""
    rows: np.ndarray
    """r of all rows below, over `UNIT` (w,) [sqrt(N/m)]."""


class Order:
    """The order of elimination of every matrix whose blocks of 3 x 3 lie where those of ``matrix`` do.

    Args:
        matrix: (3 n, 3 n), three unknowns for each node, as `blocks_of` gives it.
        points: places of the nodes (n, 3), which only guide the order.
    """

    tables: np.ndarray
    """Of every front (f, 7): pivots and rows below, each with its padded number; where pivots, the blocks and the rows
    below begin."""
    place: np.ndarray
    """Of every unknown (3 n,) in the padded vector of all fronts."""
    below: np.ndarray
    """Places of the rows below of all fronts (w,)."""
    slots: int
    """Length of the padded vector."""
    owners: np.ndarray
    """Row of nodes of every block (b,)."""
    neighbours: np.ndarray
    """Column of nodes of every block (b,), ascending in each row."""
    bytes: float
    """Memory of a factor while it is made [byte]."""
    work: float
    """Multiplications of an elimination for each number that it stores [-]; a solve reads every number twice."""

    def __init__(self, matrix: sp.bsr_matrix, points: np.ndarray):
        self.start, self.neighbours = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        count = len(self.start) - 1
        self.owners = np.repeat(np.arange(count), np.diff(self.start))
        self._keys = self.owners * count + self.neighbours
        tree = fronts(sp.csr_matrix((np.ones(len(self._keys)), self.neighbours, self.start), (count, count)), points)
        self.place = np.empty(3 * count, np.int32)
        self.tables = np.zeros((len(tree), 7), np.int64)
        # of every front: own nodes, nodes below and children end here; the update of its children begins there
        self._at = np.zeros((len(tree) + 1, 4), np.int64)
        slots, entries, below, self._room = 0, 0, 0, 0
        for f, front in enumerate(tree):
            p, q = 3 * len(front.own), 3 * len(front.boundary)
            pw, qw = _padded(p), _padded(q)
            self.place[_unknowns(front.own)] = slots + np.arange(p)
            self.tables[f] = p, pw, q, qw, slots, entries, below
            slots, entries, below = slots + pw, entries + p * (pw + qw), below + q
            # a front's update takes the place of its children's
            here = self._at[front.children[0], 3] if front.children else self._at[f, 3]
            self._at[f, 3], self._at[f + 1, 3] = here, here + q * q
            self._at[f + 1, :3] = self._at[f, :3] + (len(front.own), len(front.boundary), len(front.children))
            self._room = max(self._room, int(here) + q * q)
        self.slots = slots
        self._entries, self._below, self._wide = entries, below, int(self.tables[:, [0, 2]].sum(axis=1).max())
        self.below = np.concatenate([*(self.place[_unknowns(front.boundary)] for front in tree), [0]]).astype(np.int32)
        self._lists = [np.concatenate([*parts, [0]]).astype(np.int32) for parts in (
            [f.own for f in tree], [f.boundary for f in tree], [np.array(f.children, np.int32) for f in tree])]
        self._own = [_unknowns(front.own) for front in tree]
        self.bytes = 2.0 * entries + 8.0 * (self._room + self._wide**2)
        p, q = self.tables[:, 0].astype(float), self.tables[:, 2].astype(float)
        self.work = float((p**3 / 1.5 + p**2 * q + p * q**2).sum()) / max(entries, 1)

    def find(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Numbers of the blocks of the nodes ``row`` and ``column`` (same shape); -1 where there is none."""
        key = row.astype(np.int64) * (len(self.start) - 1) + column
        at = np.searchsorted(self._keys, key)
        return np.where(self._keys[np.minimum(at, len(self._keys) - 1)] == key, at, -1).astype(np.int32)

    def walk(self, values: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray]]:
        """The fronts of the matrix with the blocks ``values`` (b, 3, 3) [N/m], children first.

        Yields:
            Number of the front; its own unknowns (p,); its matrix (p + q, p + q), of which only the lower triangle
            means anything, with its own p rows first; and where its update (q, q) must be written before the next front
            is asked for, its lower triangle at least.
        """
        work, stack = np.zeros(self._wide**2), np.empty(self._room)  # zeros: what lies above the diagonal is finite
        arrays = [wp.array(a.ravel(), device="cpu", copy=False) for a in (
            self._at, *self._lists, self.start, self.neighbours, values, np.full(len(self.start) - 1, -1, np.int32),
            work, stack)]
        for f, own in enumerate(self._own):
            p, q = int(self.tables[f, 0]), int(self.tables[f, 2])
            wp.launch(gather_kernel(), dim=1, device="cpu", inputs=[f, *arrays])
            dense = work[:(p + q)**2].reshape(p + q, p + q)
            update = stack[self._at[f, 3]:self._at[f, 3] + q * q].reshape(q, q)
            if p:
                yield f, own, dense, update
            else:  # no edges connect the halves
                update[:] = dense

    def unknowns_below(self, front: int) -> np.ndarray:
        """Later unknowns (q,) that those of a ``front`` are connected to, in the order of its matrix."""
        return _unknowns(self._lists[1][self._at[front, 1]:self._at[front + 1, 1]])

    def eliminate(self, values: np.ndarray) -> Factor:
        """Eliminate the matrix with the blocks ``values`` (b, 3, 3) [N/m], in the order of ``matrix``'s.

        Raises:
            MeshError: the matrix is not positive definite.
        """
        out = Factor(np.zeros(self._entries, np.int16), np.zeros(self.slots, np.float32),
                     np.zeros(self._below, np.float32))
        count = len(self.start) - 1
        diagonal = np.zeros((count, 3))
        on = self.owners == self.neighbours
        diagonal[self.owners[on]] = np.diagonal(values[on], axis1=1, axis2=2)
        diagonal = diagonal.ravel()
        for f, own, dense, update in self.walk(values):
            p, pw, q, qw, slot, first, below = self.tables[f].tolist()
            lower, fault = lapack.dpotrf(dense[:p, :p], lower=True)
            inverse, _ = lapack.dpotri(lower, lower=True)
            if fault or (np.diag(inverse) * diagonal[own] > _LOOSE).any():
                raise MeshError(NOT_DEFINITE)
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
            ties = dense[p:, :p]
            gain = ties @ inverse
            d = np.sqrt(np.diag(inverse))
            share = gain / d  # of a force of 1/d
            r = np.maximum(np.abs(share).max(axis=1, initial=0.0), 1e-300)
            out.blocks[first:first + p * pw].reshape(p, pw)[:, :p] = np.rint(UNIT * (inverse / d / d[:, None]))
            out.blocks[first + p * pw:first + p * (pw + qw)].reshape(p, qw)[:, :q] = np.rint(
                UNIT * (share / r[:, None])).T
            out.pivots[slot:slot + p], out.rows[below:below + q] = d, r / UNIT
            for end in range(_STRIP, q + _STRIP, _STRIP):  # only the lower triangle is read
                rows = update[end - _STRIP:end, :end]
                np.matmul(gain[end - _STRIP:end], ties[:end].T, out=rows)
                np.subtract(dense[p + end - _STRIP:p + end, p:p + end], rows, out=rows)
        return out


def blocks_of(matrix: sp.spmatrix) -> sp.bsr_matrix:
    """The blocks of a matrix (3 n, 3 n), ascending in each row."""
    out = matrix.tobsr((3, 3))
    out.sort_indices()
    return out


def _padded(count: int) -> int:
    """Length of a padded row."""
    return -(-count // _PAD) * _PAD


def _unknowns(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


# A front's lower triangle: the matrix's rows of its own nodes, and the lower triangles of its children's updates. The
# nodes of a child stand in the same order in its parent.
_GATHER = """
    const long long* t = ends.data + 4 * f;
    const int* mine = own.data + t[0]; const int* under = below.data + t[1]; const int* child = children.data + t[2];
    const int p = t[4] - t[0], q = t[5] - t[1], some = t[6] - t[2];
    int* local = locals.data;
    double* front = work.data;
    const long long w = 3 * (p + q);
    for (int i = 0; i < p; ++i) local[mine[i]] = i;
    for (int i = 0; i < q; ++i) local[under[i]] = p + i;
    for (long long i = 0; i < w; ++i) for (long long j = 0; j <= i; ++j) front[i * w + j] = 0.0;
    for (int i = 0; i < p; ++i) for (int k = starts.data[mine[i]]; k < starts.data[mine[i] + 1]; ++k) {
        const int j = local[neighbours.data[k]];
        if (j < i) continue;  // eliminated before, or its transpose stands there
        const double* v = values.data + 9LL * k;
        for (int a = 0; a < 3; ++a) for (int b = 0; b < 3; ++b) front[(3 * j + a) * w + 3 * i + b] = v[3 * b + a];
    }
    for (int c = 0; c < some; ++c) {
        const long long* s = ends.data + 4 * child[c];
        const int* nodes = below.data + s[1];
        const int m = s[5] - s[1];
        const double* update = stack.data + s[3];
        for (int i = 0; i < m; ++i) for (int a = 0; a < 3; ++a) {
            double* row = front + (3 * local[nodes[i]] + a) * w;
            const double* from = update + (3LL * i + a) * 3 * m;
            for (int j = 0; j <= i; ++j) {
                double* to = row + 3 * local[nodes[j]];
                to[0] += from[3 * j]; to[1] += from[3 * j + 1]; to[2] += from[3 * j + 2];
            }
        }
    }
    for (int i = 0; i < p; ++i) local[mine[i]] = -1;
    for (int i = 0; i < q; ++i) local[under[i]] = -1;
"""


@functools.cache
def gather_kernel() -> Any:
    """The kernel that adds up the matrix of a front."""
    long, whole, double = (wp.array(dtype=t) for t in (wp.int64, wp.int32, wp.float64))

    def gather(f: int, ends: long, own: whole, below: whole, children: whole, starts: whole, neighbours: whole,
               values: double, locals: whole, work: double, stack: double): ...

    native = wp.func_native(_GATHER)(gather)

    def run(f: int, ends: long, own: whole, below: whole, children: whole, starts: whole, neighbours: whole,
            values: double, locals: whole, work: double, stack: double):
        native(f, ends, own, below, children, starts, neighbours, values, locals, work, stack)

    return wp.Kernel(run, key="multifrontal_gather")
