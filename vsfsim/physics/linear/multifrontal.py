"""A Cholesky factor in sixteen bits, as a preconditioner on a CPU: reading the factor is the cost of a solve, and this
one has a quarter of the usual size.

The matrix is eliminated front by front (Duff and Reid 1983) along a nested dissection, in float64. Of a front with the
pivots A and the rows B below them only A^-1 and G = B A^-1 are stored, so that a solve is products with dense blocks,

    x_B -= G x_A  (children first),     x_A = A^-1 x_A - G^T x_B  (parents first).

With d the roots of the diagonal of A^-1, A^-1 = d Q d and G = r P d, where the entries of Q and P are at most 1: these
are stored as integers, in units of 2^-15. That rounds every entry by 1.5e-5 relative to the compliances of its own
unknowns, so soft parts beside stiff ones keep their accuracy. The compliance of a slender body far from its supports
may be lost; `trusted` tests it.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from vsfsim.physics import clock
from vsfsim.physics.linear.elimination import UNIT, Order, blocks_of, gather_kernel
from vsfsim.physics.runtime import ON_THE_HOST

_WIDE = 16  # right-hand sides that share one reading of the factor
_FEW = 4  # fewer right-hand sides are solved one by one
_ROWS = 4  # rows of a block that are unpacked together
TRUST = 2e-2
"""Relative error in the energy norm up to which the factor preconditions as well as the exact one [-]."""


class Multifrontal:
    """A symmetric positive definite matrix, factorised; `solve` is approximate.

    Args:
        order: the order of elimination.
        values: the blocks of the matrix (b, 3, 3), in the sequence of ``order``.

    Raises:
        MeshError: the matrix is not positive definite.
    """

    order: Order
    """Its order of elimination."""
    seconds: float
    """Duration of the elimination [s]."""

    def __init__(self, order: Order, values: np.ndarray):
        began = clock.now()
        self.order, self.size = order, len(order.place)
        factor = order.eliminate(values)
        self.seconds = clock.now() - began
        tables = order.tables
        self._slots, self._wide, self._fronts = order.slots, int(tables[:, [1, 3]].max()), len(tables)
        self.bytes = sum(a.nbytes for a in (factor.blocks, factor.pivots, factor.rows))
        arrays = (tables, order.below, order.place, factor.blocks, factor.pivots, factor.rows)
        self._arrays = [wp.array(a.ravel(), device="cpu") for a in arrays]
        self._vectors: dict[int, list[wp.array]] = {}  # of a solve, by its width

    @classmethod
    def of(cls, matrix: sp.spmatrix, points: np.ndarray) -> "Multifrontal":
        """The factor of ``matrix`` (3 n, 3 n), see `Order`, and errors as the class."""
        blocks = blocks_of(matrix)
        return cls(Order(blocks, points), np.asarray(blocks.data, np.float64))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """An approximation of the inverse times ``right``, both (3 n, k) in double."""
        right = np.ascontiguousarray(right, np.float64)
        out = np.empty_like(right)
        columns = right.shape[1]
        width = _WIDE if columns >= _FEW else 1
        if width not in self._vectors:  # the padding stays 0
            self._vectors[width] = [wp.zeros(size, dtype=wp.float32, device="cpu")
                                    for size in (self._slots * width, (2 * width + _ROWS) * self._wide)]
        ends = [wp.array(a.reshape(-1), device="cpu", copy=False) for a in (right, out)]
        for start in range(0, columns, width):
            wp.launch(_kernels()[width], dim=1, device="cpu",
                      inputs=[self._fronts, self.size, self._wide, columns, start, *self._arrays, *ends,
                              *self._vectors[width]])
        return out


def factor_kernels() -> list[Any]:
    """One kernel of each module that a factor is made and applied with, on the host."""
    kernels = [gather_kernel(), _kernels()[1]]
    ON_THE_HOST.update(kernel.module.name for kernel in kernels)
    return kernels


def trusted(matrix: sp.spmatrix, solve: Callable[[np.ndarray], np.ndarray], loads: np.ndarray, *,
            within: float = TRUST) -> bool:
    """Whether ``solve`` answers ``loads`` (3 n, k) to the relative error ``within`` in the matrix's energy norm."""
    x = solve(loads)
    miss = loads - matrix @ x
    # |e|_A^2 = e . A e with e = A^-1 miss, itself found by the factor; |x|_A^2 = x . b
    error, energy = np.einsum("ij,ij->j", solve(miss), miss), np.einsum("ij,ij->j", x, loads)
    return bool(np.isfinite(x).all() and (energy > 0.0).all() and (np.abs(error) <= within**2 * energy).all())


# Two sweeps through the fronts: for one right-hand side, and for sixteen in one vector. Four rows of a block are read
# at a time. Both read the forces from ``right`` and write the result to ``out``, each column scaled by its largest
# entry, since single precision underflows for forces that are far below one.
_BEGIN = f"""
    const long long* t = table.data; const int* below = rows.data; const int* place = places.data;
    const short* block = blocks.data;
    const float* pivot = pivots.data; const float* ratio = ratios.data; const double* b = right.data + start;
    const float unit = 1.0f / {UNIT}f;
    // numbers in a cache line, and how far ahead of its use a line is prefetched: the processor itself prefetches no
    // further than a page, and rows are short
    const int LINE = 32, AHEAD = 4096, BEHIND = 2048;
"""
_FRONT = """
        const long long p = t[7*f], pw = t[7*f+1], q = t[7*f+2], qw = t[7*f+3];
        const float* d = pivot + t[7*f+4];
        const short* inverse = block + t[7*f+5];
        const short* ties = inverse + p * pw;
        const float* r = ratio + t[7*f+6];
        const int* at = below + t[7*f+6];
"""
_SINGLE = _BEGIN + """
    float* v = x.data; float* there = work.data; float* own = there + wide;
    double most = 1e-300;
    for (int i = 0; i < size; ++i) {
        const double s = b[(long long)i * columns];
        most = s > most ? s : (-s > most ? -s : most);
    }
    const double scale = 1.0 / most;
    for (int i = 0; i < size; ++i) v[place[i]] = (float)(b[(long long)i * columns] * scale);
    for (int f = 0; f < fronts; ++f) {""" + _FRONT + """
        float* a = v + t[7*f+4];
        for (long long j = 0; j < p; ++j) a[j] *= d[j];
        for (long long k = 0; k < qw; ++k) there[k] = 0.0f;
        for (long long j = 0; j < p; j += 4) {
            const long long left = p - j;
            const short* s0 = ties + j * qw; const short* s1 = s0 + (left > 1) * qw;
            const short* s2 = s1 + (left > 2) * qw; const short* s3 = s2 + (left > 3) * qw;
            for (long long k = 0; k < 4 * qw; k += LINE) __builtin_prefetch(s0 + AHEAD + k);
            const float a0 = a[j], a1 = left > 1 ? a[j + 1] : 0.0f;
            const float a2 = left > 2 ? a[j + 2] : 0.0f, a3 = left > 3 ? a[j + 3] : 0.0f;
            for (long long k = 0; k < qw; ++k)
                there[k] += (float)s0[k] * a0 + (float)s1[k] * a1 + (float)s2[k] * a2 + (float)s3[k] * a3;
        }
        for (long long k = 0; k < q; ++k) v[at[k]] -= r[k] * there[k];
    }
    for (int f = fronts - 1; f >= 0; --f) {""" + _FRONT + """
        float* a = v + t[7*f+4];
        for (long long k = 0; k < q; ++k) there[k] = r[k] * v[at[k]];
        for (long long k = q; k < qw; ++k) there[k] = 0.0f;
        for (long long j = p - 1; j >= 0; --j) {
            const short* row = inverse + j * pw; const short* tie = ties + j * qw;
            for (long long k = 0; k < pw; k += LINE) __builtin_prefetch(row - BEHIND + k);
            for (long long k = 0; k < qw; k += LINE) __builtin_prefetch(tie - BEHIND + k);
            float part[16] = {0}, other[16] = {0}, sum = 0.0f;
            for (long long k = 0; k < pw; k += 16) for (int l = 0; l < 16; ++l) part[l] += (float)row[k + l] * a[k + l];
            for (long long k = 0; k < qw; k += 16)
                for (int l = 0; l < 16; ++l) other[l] += (float)tie[k + l] * there[k + l];
            for (int l = 0; l < 16; ++l) sum += unit * part[l] - other[l];
            own[j] = d[j] * sum;
        }
        for (long long j = 0; j < p; ++j) a[j] = own[j];
    }
    double* answer = out.data + start;
    for (int i = 0; i < size; ++i) answer[(long long)i * columns] = most * v[place[i]];
"""
_UNPACK = """
            const long long left = p - j;
            const short* s0 = first + j * width; const short* s1 = s0 + (left > 1) * width;
            const short* s2 = s1 + (left > 2) * width; const short* s3 = s2 + (left > 3) * width;
            for (long long k = 0; k < width; ++k) { r0[k] = s0[k]; r1[k] = s1[k]; r2[k] = s2[k]; r3[k] = s3[k]; }
"""
_MANY = _BEGIN + """
    typedef float lanes __attribute__((vector_size(64), aligned(4)));
    lanes* v = (lanes*)x.data; lanes* there = (lanes*)work.data; lanes* own = there + wide;
    float* r0 = (float*)(own + wide); float* r1 = r0 + wide; float* r2 = r1 + wide; float* r3 = r2 + wide;
    const lanes none = {0};
    const int some = columns - start < 16 ? columns - start : 16;
    double most[16], scale[16];
    for (int l = 0; l < 16; ++l) most[l] = 1e-300;
    for (int i = 0; i < size; ++i) for (int l = 0; l < some; ++l) {
        const double s = b[(long long)i * columns + l];
        most[l] = s > most[l] ? s : (-s > most[l] ? -s : most[l]);
    }
    for (int l = 0; l < 16; ++l) scale[l] = 1.0 / most[l];
    for (int i = 0; i < size; ++i) {
        float* to = (float*)(v + place[i]);
        for (int l = 0; l < some; ++l) to[l] = (float)(b[(long long)i * columns + l] * scale[l]);
        for (int l = some; l < 16; ++l) to[l] = 0.0f;
    }
    for (int f = 0; f < fronts; ++f) {""" + _FRONT + """
        lanes* a = v + t[7*f+4];
        for (long long j = 0; j < p; ++j) a[j] *= d[j];
        for (long long k = 0; k < q; ++k) there[k] = none;
        const short* first = ties; const long long width = qw;
        for (long long j = 0; j < p; j += 4) {""" + _UNPACK + """
            const lanes a0 = a[j], a1 = left > 1 ? a[j + 1] : none;
            const lanes a2 = left > 2 ? a[j + 2] : none, a3 = left > 3 ? a[j + 3] : none;
            for (long long k = 0; k < q; ++k) there[k] += r0[k] * a0 + r1[k] * a1 + r2[k] * a2 + r3[k] * a3;
        }
        for (long long k = 0; k < q; ++k) v[at[k]] -= r[k] * there[k];
    }
    for (int f = fronts - 1; f >= 0; --f) {""" + _FRONT + """
        lanes* a = v + t[7*f+4];
        for (long long k = 0; k < q; ++k) there[k] = r[k] * v[at[k]];
        for (int half = 0; half < 2; ++half) {
            const short* first = half ? ties : inverse;
            const lanes* with = half ? there : a;
            const long long width = half ? qw : pw, count = half ? q : p;
            const float sign = half ? -1.0f : unit;
            for (long long j = 0; j < p; j += 4) {""" + _UNPACK + """
                lanes t0 = {0}, t1 = {0}, t2 = {0}, t3 = {0};
                for (long long k = 0; k < count; ++k) {
                    const lanes u = with[k];
                    t0 += r0[k] * u; t1 += r1[k] * u; t2 += r2[k] * u; t3 += r3[k] * u;
                }
                own[j] = (half ? own[j] : none) + sign * t0;
                if (left > 1) own[j + 1] = (half ? own[j + 1] : none) + sign * t1;
                if (left > 2) own[j + 2] = (half ? own[j + 2] : none) + sign * t2;
                if (left > 3) own[j + 3] = (half ? own[j + 3] : none) + sign * t3;
            }
        }
        for (long long j = 0; j < p; ++j) a[j] = d[j] * own[j];
    }
    double* answer = out.data + start;
    for (int i = 0; i < size; ++i) {
        const float* from = (const float*)(v + place[i]);
        for (int l = 0; l < some; ++l) answer[(long long)i * columns + l] = most[l] * from[l];
    }
"""


@functools.cache
def _kernels() -> dict[int, Any]:
    """The solve for one and for sixteen right-hand sides: one thread, since each front waits for the ones below it."""
    return {1: _kernel("single", _SINGLE), _WIDE: _kernel("many", _MANY)}


def _kernel(name: str, text: str) -> Any:
    long, whole, short, single, double = (
        wp.array(dtype=t) for t in (wp.int64, wp.int32, wp.int16, wp.float32, wp.float64))

    def sweep(fronts: int, size: int, wide: int, columns: int, start: int, table: long, rows: whole, places: whole,
              blocks: short, pivots: single, ratios: single, right: double, out: double, x: single, work: single): ...

    sweep.__name__ = sweep.__qualname__ = f"sweep_{name}"
    native = wp.func_native(text)(sweep)

    def solve(fronts: int, size: int, wide: int, columns: int, start: int, table: long, rows: whole, places: whole,
              blocks: short, pivots: single, ratios: single, right: double, out: double, x: single, work: single):
        native(fronts, size, wide, columns, start, table, rows, places, blocks, pivots, ratios, right, out, x, work)

    return wp.Kernel(solve, key=f"multifrontal_solve_{name}")
