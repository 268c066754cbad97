"""A Cholesky factor in single precision, as a preconditioner on a CPU: what a solve costs is the reading of the factor, and this one is read at the
memory's own pace.

The matrix is eliminated front by front (Duff and Reid 1983) along a nested dissection, in double. Of a front with the pivots A and the rows B below
them only A^-1 and G = B A^-1 are kept, in single precision, so that a solve is products with dense blocks,

    x_B -= G x_A  (children first),     x_A = A^-1 x_A - G^T x_B  (parents first).

Rounding each block by 6e-8 of its own entries leaves soft parts beside stiff ones what they are; the long way from a support through a slender body is
what single precision may lose. `trusted` finds out.
"""

import functools
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.linalg import lapack

from vsfsim.core.errors import MeshError
from vsfsim.physics.dissection import Front, fronts

_PAD = 16  # single-precision numbers that a row is a multiple of: whole vectors of the processor
_WIDE = 16  # right-hand sides that share one reading of the factor
_FEW = 4  # fewer are answered one by one
_TRUST = 1e-2  # relative error of an answer, in the energy norm, up to which it preconditions as well as the exact one


class Multifrontal:
    """(3 n, 3 n) symmetric positive definite, factorised; `solve` answers in single precision.

    size: 3 n. bytes: of the factor in memory.

    Args:
        matrix: (3 n, 3 n), three unknowns a node. points: of the nodes (n, 3), which only guide the order.

    Raises:
        MeshError: the matrix is not positive definite.
    """

    def __init__(self, matrix: sp.spmatrix, points: np.ndarray):
        matrix = matrix.tocsr()
        self.size = matrix.shape[0]
        coo = matrix.tocoo()
        count = self.size // 3
        graph = sp.csr_matrix((np.ones(coo.nnz), (coo.row // 3, coo.col // 3)), shape=(count, count))
        tree = fronts(graph, points)
        self._place = np.empty(self.size, np.int64)  # of every unknown in the padded vector of all fronts
        tables = np.zeros((len(tree), 5), np.int64)  # pivots, row length, rows below; where pivots, and the front's blocks, begin
        slots, entries, below = 0, 0, 0
        for f, front in enumerate(tree):
            p, q = 3 * len(front.own), 3 * len(front.boundary)
            width = -(-p // _PAD) * _PAD
            self._place[_unknowns(front.own)] = slots + np.arange(p)
            tables[f] = p, width, q, slots, entries
            slots, entries, below = slots + width, entries + (p + q) * width, below + q
        self._slots = slots
        self._blocks = np.zeros(entries, np.float32)
        rows = [self._place[_unknowns(front.boundary)] for front in tree]
        _eliminate(matrix, tree, tables, self._blocks)
        self.bytes = self._blocks.nbytes
        self._widest = int(tables[:, 1].max())
        starts = np.concatenate([[0], np.cumsum(tables[:, 2])[:-1]])
        self._arrays = [wp.array(np.hstack([tables, starts[:, None]]).ravel(), dtype=wp.int64, device="cpu"),
                        wp.array(np.concatenate([*rows, [0]]).astype(np.int32), dtype=wp.int32, device="cpu"),
                        wp.array(self._blocks, dtype=wp.float32, device="cpu")]
        self._fronts = len(tree)
        self._vectors: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # of a solve, by its width

    def solve(self, right: np.ndarray) -> np.ndarray:
        """An approximation of the inverse times ``right``, both (3 n, k) in double."""
        out = np.empty(right.shape)
        width = _WIDE if right.shape[1] >= _FEW else 1
        if width not in self._vectors:
            self._vectors[width] = np.zeros((self._slots, width), np.float32), np.zeros(self._widest * width, np.float32)
        x, work = self._vectors[width]  # the padding stays 0
        inputs = [self._fronts, *self._arrays, *(wp.array(a.reshape(-1), device="cpu", copy=False) for a in (x, work))]
        for start in range(0, right.shape[1], width):
            part = right[:, start:start + width]
            k = part.shape[1]
            # single precision has no room for forces that are far below one: every column by its own measure
            scale = np.maximum(np.abs(part).max(axis=0), 1e-300)
            if k < width:
                x[:] = 0.0
            x[self._place, :k] = part * (1.0 / scale)
            wp.launch(_kernels()[width], dim=1, device="cpu", inputs=inputs)
            out[:, start:start + width] = x[self._place, :k] * scale
        return out


def trusted(matrix: sp.spmatrix, factor: Multifrontal, loads: np.ndarray) -> bool:
    """Does the factor answer ``loads`` (3 n, k) to `_TRUST` in the energy norm of the matrix?"""
    x = factor.solve(loads)
    miss = loads - matrix @ x
    # |e|_A^2 = e . A e with e = A^-1 miss, itself found by the factor; |x|_A^2 = x . b
    error, energy = np.einsum("ij,ij->j", factor.solve(miss), miss), np.einsum("ij,ij->j", x, loads)
    return bool(np.isfinite(x).all() and (energy > 0.0).all() and (np.abs(error) <= _TRUST**2 * energy).all())


def _unknowns(nodes: np.ndarray) -> np.ndarray:
    return (3 * nodes[:, None] + np.arange(3)).ravel()


def _eliminate(matrix: sp.csr_matrix, tree: list[Front], tables: np.ndarray, blocks: np.ndarray) -> None:
    """Fill ``blocks`` with A^-1 (p rows) and, after it, G (q rows) of every front."""
    local = np.full(matrix.shape[0], -1)
    left: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # of fronts whose parent is still to come: what they leave on their boundary
    for f, (front, (p, width, q, _, first)) in enumerate(zip(tree, tables, strict=True)):
        own, boundary = _unknowns(front.own), _unknowns(front.boundary)
        local[own] = np.arange(p)
        local[boundary] = p + np.arange(q)
        dense = np.zeros((p + q, p + q))
        rows = matrix[own].tocoo()
        column = local[rows.col]
        kept = column >= 0  # the others were eliminated before, and stand in the children
        dense[column[kept], rows.row[kept]] = rows.data[kept]
        for c in front.children:
            if c in left:
                update, unknowns = left.pop(c)
                at = local[unknowns]
                dense[np.ix_(at, at)] += update
        local[own] = local[boundary] = -1
        if not p:  # the halves were not tied to each other
            left[f] = dense, boundary
            continue
        lower, fault = lapack.dpotrf(dense[:p, :p], lower=True)
        if fault:
            raise MeshError("The stiffness of the body at rest is not positive definite: a part of it can move freely, or elements have no volume. "
                            "Hold the body by more of its nodes, or mend the mesh.")
        inverse, _ = lapack.dpotri(lower, lower=True)
        inverse = np.tril(inverse) + np.tril(inverse, -1).T
        ties = dense[p:, :p]
        gain = ties @ inverse
        own_block = blocks[first:first + p * width].reshape(p, width)
        own_block[:, :p] = inverse
        blocks[first + p * width:first + (p + q) * width].reshape(q, width)[:, :p] = gain
        if q:
            left[f] = dense[p:, p:] - gain @ ties.T, boundary


# One right-hand side: a row of a block times the pivots' values in 16 sums side by side. Sixteen of them, in one vector: four rows at a time.
_SINGLE = """
    const long long* t = table.data; const int* below = rows.data; const float* block = blocks.data; float* v = x.data; float* own = work.data;
    for (int f = 0; f < fronts; ++f) {
        const long long p = t[6*f], width = t[6*f+1], q = t[6*f+2];
        const float* a = v + t[6*f+3];
        const float* gain = block + t[6*f+4] + p * width;
        const int* at = below + t[6*f+5];
        for (long long i = 0; i < q; ++i) {
            const float* row = gain + i * width;
            float part[16] = {0}, sum = 0.0f;
            for (long long j = 0; j < width; j += 16) for (int l = 0; l < 16; ++l) part[l] += row[j + l] * a[j + l];
            for (int l = 0; l < 16; ++l) sum += part[l];
            v[at[i]] -= sum;
        }
    }
    for (int f = fronts - 1; f >= 0; --f) {
        const long long p = t[6*f], width = t[6*f+1], q = t[6*f+2];
        float* a = v + t[6*f+3];
        const float* inverse = block + t[6*f+4];
        const float* gain = inverse + p * width;
        const int* at = below + t[6*f+5];
        for (long long i = 0; i < p; ++i) {
            const float* row = inverse + i * width;
            float part[16] = {0}, sum = 0.0f;
            for (long long j = 0; j < width; j += 16) for (int l = 0; l < 16; ++l) part[l] += row[j + l] * a[j + l];
            for (int l = 0; l < 16; ++l) sum += part[l];
            own[i] = sum;
        }
        for (long long i = p; i < width; ++i) own[i] = 0.0f;
        for (long long i = 0; i < q; ++i) {
            const float* row = gain + i * width;
            const float s = v[at[i]];
            for (long long j = 0; j < width; ++j) own[j] -= row[j] * s;
        }
        for (long long i = 0; i < p; ++i) a[i] = own[i];
    }
"""
_MANY = """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    const long long* t = table.data; const int* below = rows.data; const float* block = blocks.data;
    lanes* v = (lanes*)x.data; lanes* own = (lanes*)work.data;
    for (int f = 0; f < fronts; ++f) {
        const long long p = t[6*f], width = t[6*f+1], q = t[6*f+2];
        const lanes* a = v + t[6*f+3];
        const float* gain = block + t[6*f+4] + p * width;
        const int* at = below + t[6*f+5];
        for (long long i = 0; i < q; i += 4) {
            const int most = q - i < 4 ? (int)(q - i) : 4;
            const float* r0 = gain + i * width; const float* r1 = r0 + (most > 1) * width;
            const float* r2 = r1 + (most > 2) * width; const float* r3 = r2 + (most > 3) * width;
            lanes s0 = {0}, s1 = {0}, s2 = {0}, s3 = {0};
            for (long long j = 0; j < p; ++j) { const lanes u = a[j]; s0 += r0[j] * u; s1 += r1[j] * u; s2 += r2[j] * u; s3 += r3[j] * u; }
            v[at[i]] -= s0;
            if (most > 1) v[at[i + 1]] -= s1;
            if (most > 2) v[at[i + 2]] -= s2;
            if (most > 3) v[at[i + 3]] -= s3;
        }
    }
    for (int f = fronts - 1; f >= 0; --f) {
        const long long p = t[6*f], width = t[6*f+1], q = t[6*f+2];
        lanes* a = v + t[6*f+3];
        const float* inverse = block + t[6*f+4];
        const float* gain = inverse + p * width;
        const int* at = below + t[6*f+5];
        for (long long i = 0; i < p; i += 4) {
            const int most = p - i < 4 ? (int)(p - i) : 4;
            const float* r0 = inverse + i * width; const float* r1 = r0 + (most > 1) * width;
            const float* r2 = r1 + (most > 2) * width; const float* r3 = r2 + (most > 3) * width;
            lanes s0 = {0}, s1 = {0}, s2 = {0}, s3 = {0};
            for (long long j = 0; j < p; ++j) { const lanes u = a[j]; s0 += r0[j] * u; s1 += r1[j] * u; s2 += r2[j] * u; s3 += r3[j] * u; }
            own[i] = s0;
            if (most > 1) own[i + 1] = s1;
            if (most > 2) own[i + 2] = s2;
            if (most > 3) own[i + 3] = s3;
        }
        long long i = 0;
        for (; i + 4 <= q; i += 4) {
            const float* r0 = gain + i * width; const float* r1 = r0 + width; const float* r2 = r1 + width; const float* r3 = r2 + width;
            const lanes s0 = v[at[i]], s1 = v[at[i + 1]], s2 = v[at[i + 2]], s3 = v[at[i + 3]];
            for (long long j = 0; j < p; ++j) own[j] -= r0[j] * s0 + r1[j] * s1 + r2[j] * s2 + r3[j] * s3;
        }
        for (; i < q; ++i) {
            const float* row = gain + i * width;
            const lanes s0 = v[at[i]];
            for (long long j = 0; j < p; ++j) own[j] -= row[j] * s0;
        }
        for (long long k = 0; k < p; ++k) a[k] = own[k];
    }
"""


@functools.cache
def _kernels() -> dict[int, Any]:
    """The solve for one and for sixteen right-hand sides: one thread, since each front waits for the ones below it."""
    return {1: _kernel("single", _SINGLE), _WIDE: _kernel("many", _MANY)}


def _kernel(name: str, text: str) -> Any:
    table, numbers, values = wp.array(dtype=wp.int64), wp.array(dtype=wp.int32), wp.array(dtype=wp.float32)

    def sweep(fronts: int, table: table, rows: numbers, blocks: values, x: values, work: values): ...

    sweep.__name__ = sweep.__qualname__ = f"sweep_{name}"
    native = wp.func_native(text)(sweep)

    def solve(fronts: int, table: table, rows: numbers, blocks: values, x: values, work: values):
        native(fronts, table, rows, blocks, x, work)

    return wp.Kernel(solve, key=f"multifrontal_solve_{name}")
