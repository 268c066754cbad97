"""A sparse Cholesky factor: dense fronts along a nested dissection of the mesh.

CHOLMOD, as cholespy calls it, eliminates column by column at the speed of the memory; dense fronts (Duff and Reid 1983)
let the processor work at its full speed. Of a front with the pivots A and the rows B below them, A^-1 and G = B A^-1
are kept, so that a solve is products with dense blocks,

    x_B -= G x_A  (children first),     x_A = A^-1 x_A - G^T x_B  (parents first).

The elimination is in double precision. The blocks may be kept in single precision, because reading them is the cost of
a solve: every entry is rounded relative to the compliances of its own unknowns, so that soft parts beside stiff ones
keep their digits. What bends easily and is stiff otherwise, as a thin plate, loses them (`RestFactor`).
"""

import functools
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lapack

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear.dissection import fronts
from vsfsim.physics.runtime import ON_THE_HOST

_WIDE = 8  # right-hand sides that share one reading of the factor
_STRIP = 192  # rows of an update that are multiplied together
NOT_DEFINITE = ("The stiffness of the body at rest is not positive definite: a part of it can move freely, or elements "
                "have no volume. Hold the body by more of its nodes, or mend the mesh.")
"""What `MeshError` says of such a matrix."""
_LOOSE = 1e-15  # a pivot below this fraction of its diagonal entry is rounding error


class Order:
    """The order of elimination of every matrix whose blocks of 3 x 3 lie where those of ``matrix`` do.

    Args:
        matrix: (3 n, 3 n), three unknowns for each node, as `blocks_of` gives it.
        points: places of the nodes (n, 3), which only guide the order.
    """

    tables: np.ndarray
    """Of every front (f, 5): own and later unknowns; where its own unknowns, its panel and its list of later ones
    begin."""
    place: np.ndarray
    """Of every unknown (3 n,) in the order of elimination."""
    below: np.ndarray
    """Places of the later unknowns of all fronts (w,)."""
    entries: int
    """Numbers of a factor."""
    work: float
    """Multiplications of an elimination for each number of the factor [-]; a solve reads every number twice."""
    owners: np.ndarray
    """Row of nodes of every block (b,)."""
    neighbours: np.ndarray
    """Column of nodes of every block (b,), ascending in each row."""

    def __init__(self, matrix: sp.bsr_matrix, points: np.ndarray):
        self.start, self.neighbours = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        count = len(self.start) - 1
        self.owners = np.repeat(np.arange(count), np.diff(self.start))
        self._keys = self.owners * count + self.neighbours
        own, later, self._children = fronts(
            sp.csr_matrix((np.ones(len(self._keys)), self.neighbours, self.start), (count, count)), points)
        self.place, self.tables = np.empty(3 * count, np.int32), np.zeros((len(own), 5), np.int64)
        slot, self.entries, below = 0, 0, 0
        for f, (mine, tied) in enumerate(zip(own, later, strict=True)):
            p, q = 3 * len(mine), 3 * len(tied)
            self.place[_unknowns(mine)] = slot + np.arange(p)
            self.tables[f] = p, q, slot, self.entries, below
            slot, self.entries, below = slot + p, self.entries + p * (p + q), below + q
        p, q = self.tables[:, 0].astype(float), self.tables[:, 1].astype(float)
        self.work = float((p**3 / 2.0 + p * p * q + p * q * q / 2.0).sum()) / max(self.entries, 1)
        self.below = np.concatenate([*(self.place[_unknowns(tied)] for tied in later), [0]]).astype(np.int32)
        # the blocks on and below the diagonal, by the place of the node that is eliminated first, and where its begin
        row, column = self.place[3 * self.owners], self.place[3 * self.neighbours]
        self._lower = np.flatnonzero(row <= column)
        self._lower = self._lower[np.argsort(row[self._lower], kind="stable")]
        self._begin = np.searchsorted(row[self._lower], 3 * np.arange(count + 1))

    def find(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Numbers of the blocks of the nodes ``row`` and ``column`` (same shape); -1 where there is none."""
        key = row.astype(np.int64) * (len(self.start) - 1) + column
        at = np.searchsorted(self._keys, key)
        return np.where(self._keys[np.minimum(at, len(self._keys) - 1)] == key, at, -1).astype(np.int32)

    def front(self, f: int, values: np.ndarray, updates: dict[int, np.ndarray]) -> np.ndarray:
        """The matrix (p + q, p + q) of a front, of which only the lower triangle means anything, with its own p rows
        first: from the blocks ``values`` (b, 3, 3) [N/m] and the ``updates`` of its children, which it takes away."""
        p, q, slot, _, at = self.tables[f].tolist()
        mine, out = np.concatenate([np.arange(slot, slot + p), self.below[at:at + q]]), np.zeros((p + q, p + q))
        some = self._lower[self._begin[slot // 3]:self._begin[(slot + p) // 3]]
        row = np.searchsorted(mine, self.place[3 * self.neighbours[some]]) // 3
        column = (self.place[3 * self.owners[some]] - slot) // 3
        out.reshape((len(mine) // 3, 3) * 2)[row, :, column] = values[some].mT
        for child in self._children[f]:
            _, q, _, _, at = self.tables[child].tolist()
            to = np.searchsorted(mine, self.below[at:at + q]).astype(np.int32)
            wp.launch(_add_update, dim=q, device="cpu", inputs=[to, updates.pop(child), out])
        return out


class Cholesky:
    """A symmetric positive definite matrix, factorised.

    Args:
        order: the order of elimination.
        values: the blocks of the matrix (b, 3, 3) [N/m], in the sequence of ``order``.
        real: precision of the blocks, np.float32 or np.float64.

    Raises:
        MeshError: the matrix is not positive definite.
    """

    def __init__(self, order: Order, values: np.ndarray, real: type = np.float64):
        panels, self.real = np.empty(order.entries, real), real
        diagonal = np.empty(len(order.place))
        on = order.owners == order.neighbours
        diagonal.reshape(-1, 3)[order.owners[on]] = np.diagonal(values[on], axis1=1, axis2=2)
        least = np.empty_like(diagonal)
        least[order.place] = _LOOSE * diagonal
        updates: dict[int, np.ndarray] = {}
        for f, (p, q, slot, first, _) in enumerate(order.tables.tolist()):
            dense = order.front(f, values, updates)
            if not p:  # no edges connect the halves
                updates[f] = dense
                continue
            lower, fault = lapack.dpotrf(dense[:p, :p], lower=True)
            if fault or (np.diag(lower)**2 < least[slot:slot + p]).any():
                raise MeshError(NOT_DEFINITE)
            inverse, _ = lapack.dpotri(lower, lower=True)
            inverse = np.tril(inverse) + np.tril(inverse, -1).T
            ties = dense[p:, :p]
            gain = ties @ inverse
            panel = panels[first:first + (p + q) * p].reshape(p + q, p)
            panel[:p], panel[p:] = inverse, gain
            updates[f] = update = dense[p:, p:]
            for end in range(_STRIP, q + _STRIP, _STRIP):  # only the lower triangle is read
                update[end - _STRIP:end, :end] -= gain[end - _STRIP:end] @ ties[:end].T
        self._size, self._fronts = len(order.place), len(order.tables)
        self._arrays = [wp.array(a.ravel(), device="cpu", copy=False) for a in (
            order.tables, order.below, order.place, panels)]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """The inverse times ``right``, both (3 n, k)."""
        right = np.ascontiguousarray(right, np.float64)
        out, columns = np.empty_like(right), right.shape[1]
        width = _WIDE if columns > 1 else 1
        ends = [wp.array(a.reshape(-1), device="cpu", copy=False) for a in (right, out)]
        work = wp.empty(2 * self._size * width, dtype=wp.float64, device="cpu")
        for start in range(0, columns, width):
            wp.launch(_solve_kernel(width, self.real is np.float64), dim=1, device="cpu",
                      inputs=[self._fronts, self._size, columns, start, *self._arrays, *ends, work])
        return out


@wp.kernel(module="vsfsim_cholesky", enable_backward=False)
def _add_update(
    to: wp.array(dtype=wp.int32),
    # state in
    update_in: wp.array2d(dtype=wp.float64),
    # state out
    front: wp.array2d(dtype=wp.float64),
):
    # of a child, at the rows and columns ``to`` of its parent
    i = wp.tid()
    for j in range(i + 1):
        front[to[i], to[j]] = front[to[i], to[j]] + update_in[i, j]


def factor_kernels() -> list[Any]:
    """One kernel of each module that a factor is made and applied with, on the host."""
    kernels = [_add_update, _solve_kernel(1, False)]
    ON_THE_HOST.update(kernel.module.name for kernel in kernels)
    return kernels


def blocks_of(matrix: sp.spmatrix) -> sp.bsr_matrix:
    """The blocks of a matrix (3 n, 3 n), ascending in each row."""
    out = matrix.tobsr((3, 3))
    out.sort_indices()
    return out


def _unknowns(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


# Two sweeps through the blocks for some right-hand sides at once, eight numbers of a row at a time for a single one.
_SOLVE = """
    typedef double LANES __attribute__((vector_size(64), aligned(8)));
    typedef REAL SHORT __attribute__((vector_size(8 * sizeof(REAL)), aligned(sizeof(REAL))));
    typedef VALUE number;
    const long long* t = table.data; const int* place = places.data; const double* b = right.data + start;
    number* v = (number*)work.data; number* own = v + size;
    const int some = columns - start < WIDTH ? columns - start : WIDTH;
    for (int i = 0; i < size; ++i) {
        double* to = (double*)(v + place[i]);
        for (int l = 0; l < WIDTH; ++l) to[l] = l < some ? b[(long long)i * columns + l] : 0.0;
    }
    for (int f = 0; f < fronts; ++f) {
        const long long p = t[5*f], q = t[5*f+1];
        const number* a = v + t[5*f+2];
        const REAL* row = panels.data + t[5*f+3] + p * p; const int* at = rows.data + t[5*f+4];
        for (long long i = 0; i < q; ++i, row += p) {
            number sum = {0};
            SUM
            v[at[i]] -= sum;
        }
    }
    for (int f = fronts - 1; f >= 0; --f) {
        const long long p = t[5*f], q = t[5*f+1];
        number* a = v + t[5*f+2];
        const REAL* row = panels.data + t[5*f+3]; const int* at = rows.data + t[5*f+4];
        for (long long i = 0; i < p; ++i, row += p) {
            number sum = {0};
            SUM
            own[i] = sum;
        }
        for (long long i = 0; i < q; ++i, row += p) {
            const number u = v[at[i]];
            for (long long j = 0; j < p; ++j) own[j] -= (double)row[j] * u;
        }
        for (long long j = 0; j < p; ++j) a[j] = own[j];
    }
    for (int i = 0; i < size; ++i) {
        const double* from = (const double*)(v + place[i]);
        for (int l = 0; l < some; ++l) out.data[(long long)i * columns + start + l] = from[l];
    }
"""
_SUM_OF_ONE = """
            LANES part = {0};
            long long j = 0;
            for (; j + 8 <= p; j += 8)
                part += __builtin_convertvector(*(const SHORT*)(row + j), LANES) * *(const LANES*)(a + j);
            for (int l = 0; l < 8; ++l) sum += part[l];
            for (; j < p; ++j) sum += row[j] * a[j];
"""
_SUM_OF_MANY = """
            for (long long j = 0; j < p; ++j) sum += (double)row[j] * a[j];
"""


@functools.cache
def _solve_kernel(width: int, double_blocks: bool) -> Any:
    """The solve for ``width`` right-hand sides: one thread, since each front waits for the ones below it."""
    long, whole, double = (wp.array(dtype=t) for t in (wp.int64, wp.int32, wp.float64))
    blocks = double if double_blocks else wp.array(dtype=wp.float32)
    text = _SOLVE.replace("SUM\n", (_SUM_OF_ONE if width == 1 else _SUM_OF_MANY) + "\n")
    text = text.replace("REAL", "double" if double_blocks else "float")
    text = text.replace("VALUE", "double" if width == 1 else "LANES").replace("WIDTH", str(width))

    def sweep(fronts: int, size: int, columns: int, start: int, table: long, rows: whole, places: whole,
              panels: blocks, right: double, out: double, work: double): ...

    name = f"{width}_{'double' if double_blocks else 'single'}"
    sweep.__name__ = sweep.__qualname__ = f"sweep_{name}"
    native = wp.func_native(text)(sweep)

    def solve(fronts: int, size: int, columns: int, start: int, table: long, rows: whole, places: whole,
              panels: blocks, right: double, out: double, work: double):
        native(fronts, size, columns, start, table, rows, places, panels, right, out, work)

    return wp.Kernel(solve, key=f"cholesky_solve_{name}")
