"""Newton's step of a tree: elimination of 6 x 6 blocks from the tips to the root and back, which costs as many blocks as there are nodes.

Level by level; the seven columns of a node, six of its coupling with the parent and the right side, are worked on by a lane each, which all factor the node's block for themselves. The loops over
a block are plain C++, which the compilers unroll: on a GPU a block then stays in registers.
"""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Here, Trees, Work
from vsfsim.physics.rods.lanes import count_all, meet
from vsfsim.physics.rods.segment import mat66

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.spatial_vectord
COLUMNS = wp.constant(8)  # lanes of a node, the last of which idles

_LOAD = """
    double d[6][6], v[6];
    auto& block = *wp::address(diagonal, b, i);
    auto& right = *wp::address(step, b, i);
    auto& pair = *wp::address(coupling, b, i);
    for (int r = 0; r < 6; ++r) {
        v[r] = right[r];
        for (int c = 0; c < 6; ++c)
            d[r][c] = block.data[r][c];
    }
    for (int kid = *wp::address(child, o + i); kid >= 0; kid = *wp::address(next, o + kid)) {
        if (*wp::address(active, b, kid) == 0)
            continue;
        auto& y = *wp::address(coupling, b, kid);
        auto& t = *wp::address(step, b, kid);
        %s
    }
    int fine = 1;
"""
# what a child leaves: Y^T (Y, t), Y its coupling after its own elimination, or A (Y, t) with the coupling A of the other side
_SYMMETRIC_KID = """
        for (int m = 0; m < 6; ++m)
            for (int r = 0; r < 6; ++r) {
                const double f = y.data[m][r];
                v[r] -= f * t[m];
                for (int c = 0; c < 6; ++c)
                    d[r][c] -= f * y.data[m][c];
            }
"""
_OTHER_KID = """
        auto& up = *wp::address(across, b, kid);
        for (int r = 0; r < 6; ++r)
            for (int m = 0; m < 6; ++m) {
                const double f = up.data[r][m];
                v[r] -= f * t[m];
                for (int c = 0; c < 6; ++c)
                    d[r][c] -= f * y.data[m][c];
            }
"""
# the columns of this lane: all seven of one thread, or one; the right side is the seventh
_COLUMNS = """
#if defined(__CUDA_ARCH__) || WP_TILE_BLOCK_DIM > 1
    const int wide = 1;
    double z[6][1];
    for (int r = 0; r < 6; ++r)
        z[r][0] = column < 6 ? pair.data[r][column] : v[r];
#else
    const int wide = 7;
    double z[6][7];
    for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 6; ++c)
            z[r][c] = pair.data[r][c];
        z[r][6] = v[r];
    }
#endif
"""
_STORE = """
#if defined(__CUDA_ARCH__) || WP_TILE_BLOCK_DIM > 1
    if (column == 6)
        for (int r = 0; r < 6; ++r)
            right[r] = z[r][0];
    else
        for (int r = 0; r < 6; ++r)
            pair.data[r][column] = z[r][0];
#else
    for (int r = 0; r < 6; ++r) {
        for (int c = 0; c < 6; ++c)
            pair.data[r][c] = z[r][c];
        right[r] = z[r][6];
    }
#endif
    return fine;
"""


@wp.func_native(snippet=_LOAD % _SYMMETRIC_KID + _COLUMNS + """
    for (int j = 0; j < 6; ++j) {
        double pivot = d[j][j];
        for (int k = 0; k < j; ++k)
            pivot -= d[j][k] * d[j][k];
        if (!(pivot > 1e-13 * ::fabs(d[j][j]))) {
            fine = 0;
            pivot = 1.0;
        }
        const double inverse = 1.0 / ::sqrt(pivot);
        d[j][j] = inverse;
        for (int r = j + 1; r < 6; ++r) {
            double e = d[r][j];
            for (int k = 0; k < j; ++k)
                e -= d[r][k] * d[j][k];
            d[r][j] = e * inverse;
        }
    }
    for (int k = 0; k < 6; ++k)
        for (int c = 0; c < wide; ++c) {
            double e = z[k][c];
            for (int m = 0; m < k; ++m)
                e -= d[k][m] * z[m][c];
            z[k][c] = e * d[k][k];
        }
    if (column == 0) {
        auto& out = *wp::address(factor, b, i);
        for (int r = 0; r < 6; ++r)
            for (int c = 0; c <= r; ++c)
                out.data[r][c] = d[r][c];
    }
""" + _STORE)
def eliminate(child: wp.array(dtype=wp.int32), next: wp.array(dtype=wp.int32), active: wp.array2d(dtype=wp.int32), diagonal: wp.array2d(dtype=mat66), coupling: wp.array2d(dtype=mat66),
              step: wp.array2d(dtype=vec6), factor: wp.array2d(dtype=mat66), b: int, o: int, i: int, column: int) -> int:
    """Node ``i`` after its children: Cholesky's factor L of its block, diagonal inverted, and L^-1 of the column. 1, or 0 where the block is not positive definite."""
    ...


@wp.func_native(snippet=_LOAD % _OTHER_KID + _COLUMNS + """
    for (int k = 0; k < 6; ++k) {
        int best = k;
        double size = ::fabs(d[k][k]);
        for (int m = k + 1; m < 6; ++m)
            if (::fabs(d[m][k]) > size) {
                best = m;
                size = ::fabs(d[m][k]);
            }
        if (!(size > 0.0)) {
            fine = 0;
            d[k][k] = 1.0;
        }
        for (int m = k + 1; m < 6; ++m)  // rows by constant numbers, so that the block stays in registers
            if (m == best) {
                for (int c = k; c < 6; ++c) {
                    const double swap = d[k][c];
                    d[k][c] = d[m][c];
                    d[m][c] = swap;
                }
                for (int c = 0; c < wide; ++c) {
                    const double swap = z[k][c];
                    z[k][c] = z[m][c];
                    z[m][c] = swap;
                }
            }
        const double inverse = 1.0 / d[k][k];
        d[k][k] = inverse;
        for (int m = k + 1; m < 6; ++m) {
            const double f = d[m][k] * inverse;
            for (int c = k + 1; c < 6; ++c)
                d[m][c] -= f * d[k][c];
            for (int c = 0; c < wide; ++c)
                z[m][c] -= f * z[k][c];
        }
    }
    for (int k = 5; k >= 0; --k)
        for (int c = 0; c < wide; ++c) {
            double e = z[k][c];
            for (int m = k + 1; m < 6; ++m)
                e -= d[k][m] * z[m][c];
            z[k][c] = e * d[k][k];
        }
""" + _STORE)
def eliminate_coulomb(child: wp.array(dtype=wp.int32), next: wp.array(dtype=wp.int32), active: wp.array2d(dtype=wp.int32), diagonal: wp.array2d(dtype=mat66), coupling: wp.array2d(dtype=mat66),
                      across: wp.array2d(dtype=mat66), step: wp.array2d(dtype=vec6), b: int, o: int, i: int, column: int) -> int:
    """As `eliminate`, for a tangent that is not symmetric: Gauss's elimination with pivots within the block, all of its inverse on the column. 1, or 0 where a pivot is lost."""
    ...


@wp.func_native(snippet="""
    auto& right = *wp::address(step, b, i);
    auto& y = *wp::address(coupling, b, i);
    auto& up = *wp::address(step, b, p);
    double v[6];
    for (int r = 0; r < 6; ++r) {
        v[r] = right[r];
        for (int c = 0; c < 6; ++c)
            v[r] -= y.data[r][c] * up[c];
    }
    if (symmetric) {
        auto& low = *wp::address(factor, b, i);
        for (int k = 5; k >= 0; --k) {
            for (int m = k + 1; m < 6; ++m)
                v[k] -= low.data[m][k] * v[m];
            v[k] *= low.data[k][k];
        }
    }
    for (int r = 0; r < 6; ++r)
        right[r] = v[r];
""")
def substitute(coupling: wp.array2d(dtype=mat66), factor: wp.array2d(dtype=mat66), step: wp.array2d(dtype=vec6), b: int, p: int, i: int, symmetric: int):
    """The step of node ``i`` after that of its parent ``p``."""
    ...


@wp.func
def solve(tree: Trees, w: Work, at: Here, tall: int, coulomb: int):
    """The step of all active nodes; ``w.step`` holds the right side before, the step after. 1, or 0 where the tangent is not positive definite, or with ``coulomb`` a pivot is lost."""
    b = at.b
    column = int(0)
    begin = int(0)
    by = int(1)
    if at.lanes > 1:
        column = at.lane % COLUMNS
        begin = at.lane / COLUMNS
        by = at.lanes / COLUMNS
    lost = int(0)
    for back in range(1, tall):
        d = tall - back
        if column < COLUMNS - 1:
            for a in range(w.level[b, d] + begin, w.level[b, d + 1], by):
                i = w.order[b, a]
                fine = int(1)
                if coulomb == 1:
                    fine = eliminate_coulomb(tree.child, tree.next, w.active, w.diagonal, w.coupling, w.across, w.step, b, at.o, i, column)
                else:
                    fine = eliminate(tree.child, tree.next, w.active, w.diagonal, w.coupling, w.step, w.factor, b, at.o, i, column)
                if fine == 0:
                    lost = lost + 1
        meet()
    if count_all(lost) > 0:
        return 0
    if at.lane == 0:
        w.step[b, 0] = vec6()
    meet()
    for d in range(1, tall):
        for a in range(w.level[b, d] + at.lane, w.level[b, d + 1], at.lanes):
            i = w.order[b, a]
            substitute(w.coupling, w.factor, w.step, b, tree.parent[at.o + i], i, 1 - coulomb)
        meet()
    return 1
