"""Solution of the Newton system of a tree: block elimination from the tips to the root, then back substitution. The
cost is linear in the number of nodes.

The elimination goes level by level. A node has seven columns, six of its coupling with the parent and the right-hand
side. Each lane eliminates the whole diagonal block and solves for one column. The loops over a block are plain C++,
which the compilers unroll: on a GPU a block then stays in registers.
"""

import warp as wp

from vsfsim.physics.rods.kernels.lanes import lane_count, sync
from vsfsim.physics.rods.kernels.segment import mat66
from vsfsim.physics.rods.structs import Thread, Trees, Work

vec6 = wp.spatial_vectord
COLUMNS = wp.constant(8)  # lanes of a node, one of which is idle
# the blocks of a segment, by the nodes of their rows and columns; the solution reads the last one if unsymmetric
CHILD, PARENT, CHILD_PARENT, PARENT_CHILD = (wp.constant(k) for k in range(4))


@wp.func_native(snippet="""
    double d[6][6], v[6], own[6];
    auto exchange = [](double& one, double& other) { const double kept = one; one = other; other = kept; };
    {
        auto& block = *wp::address(blocks, b, i, 0);
        auto& g = *wp::address(gradient, b, i);
        for (int r = 0; r < 6; ++r) {
            v[r] = -g[r];
            for (int c = 0; c < 6; ++c)
                d[r][c] = block.data[r][c];
        }
    }
    // subtract the children's A (Y, t), where A couples to the child and (Y, t) is what their elimination gave
    for (int kid = *wp::address(child, o + i); kid >= 0; kid = *wp::address(next, o + kid)) {
        if (*wp::address(active, b, kid) == 0)
            continue;
        auto& y = *wp::address(passed, b, kid);
        auto& t = *wp::address(held, b, kid);
        auto& pair = *wp::address(blocks, b, kid, symmetric ? 2 : 3);
        for (int r = 0; r < 6; ++r)
            for (int m = 0; m < 6; ++m) {
                const double f = symmetric ? pair.data[m][r] : pair.data[r][m];
                v[r] -= f * t[m];
                for (int c = 0; c < 6; ++c)
                    d[r][c] -= f * y.data[m][c];
            }
    }
    // the columns of this lane: one, or all seven with a single lane; the right-hand side is the seventh
#if defined(__CUDA_ARCH__)
    constexpr int wide = 1;
#else
    constexpr int wide = 7;
#endif
    double z[6][wide];
    auto& pair = *wp::address(blocks, b, i, 2);
    for (int r = 0; r < 6; ++r)
        for (int c = 0; c < wide; ++c)
            z[r][c] = column + c < 6 ? pair.data[r][column + c] : v[r];
    int fine = 1;
    for (int k = 0; k < 6; ++k)
        own[k] = ::fabs(d[k][k]);
    for (int k = 0; k < 6; ++k) {
        if (symmetric) {
            // the pivots are the squares of those of the Cholesky factor
            if (!(d[k][k] > 1e-13 * own[k])) {
                fine = 0;
                d[k][k] = 1.0;
            }
        } else {
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
            for (int m = k + 1; m < 6; ++m)  // constant row numbers keep the block in registers
                if (m == best) {
                    for (int c = k; c < 6; ++c)
                        exchange(d[k][c], d[m][c]);
                    for (int c = 0; c < wide; ++c)
                        exchange(z[k][c], z[m][c]);
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
    auto& pass = *wp::address(passed, b, i);
    auto& hold = *wp::address(held, b, i);
    for (int r = 0; r < 6; ++r)
        for (int c = 0; c < wide; ++c)
            (column + c < 6 ? pass.data[r][column + c] : hold[r]) = z[r][c];
    return fine;
""")
def eliminate(child: wp.array(dtype=wp.int32), next: wp.array(dtype=wp.int32), active: wp.array2d(dtype=wp.int32),
              blocks: wp.array3d(dtype=mat66), gradient: wp.array2d(dtype=vec6), passed: wp.array2d(dtype=mat66),
              held: wp.array2d(dtype=vec6), b: int, o: int, i: int, column: int, symmetric: int) -> int:
    """Eliminates node ``i``, whose children are eliminated already: applies the inverse of its block to the column.

    A symmetric system is solved without pivoting, an unsymmetric one with row pivoting.

    Returns:
        1, or 0 where the symmetric block is not positive definite or the unsymmetric one is singular.
    """
    ...


@wp.func_native(snippet="""
    auto& out = *wp::address(step, b, i);
    auto& hold = *wp::address(held, b, i);
    auto& y = *wp::address(passed, b, i);
    auto& up = *wp::address(step, b, p);
    for (int r = 0; r < 6; ++r) {
        double v = hold[r];
        for (int c = 0; c < 6; ++c)
            v -= y.data[r][c] * up[c];
        out[r] = v;
    }
""")
def substitute(passed: wp.array2d(dtype=mat66), held: wp.array2d(dtype=vec6), step: wp.array2d(dtype=vec6), b: int,
               p: int, i: int):
    """The step of node ``i`` from that of its parent ``p``."""
    ...


@wp.func
def solve(tree: Trees, w: Work, me: Thread, levels: int, coulomb: int):
    """Solves for the step of all active nodes.

    Returns:
        1, or 0 where the tangent is not positive definite, or with ``coulomb`` (the unsymmetric system) singular.
    """
    b = me.b
    column = me.lane % COLUMNS
    begin = me.lane / COLUMNS
    by = wp.max(me.lanes / COLUMNS, 1)
    lost = int(0)
    for back in range(1, levels):
        d = levels - back
        if column < COLUMNS - 1:
            for a in range(w.nodes.level[b, d] + begin, w.nodes.level[b, d + 1], by):
                i = w.nodes.order[b, a]
                fine = eliminate(tree.child, tree.next, w.nodes.active, w.system.blocks, w.system.gradient,
                                 w.system.eliminated_coupling, w.system.eliminated_gradient, b, me.o, i, column,
                                 1 - coulomb)
                if fine == 0:
                    lost = lost + 1
        sync()
    if lane_count(lost) > 0:
        return 0
    if me.lane == 0:
        w.system.step[b, 0] = vec6()
    sync()
    for d in range(1, levels):
        for a in range(w.nodes.level[b, d] + me.lane, w.nodes.level[b, d + 1], me.lanes):
            i = w.nodes.order[b, a]
            p = tree.parent[me.o + i]
            substitute(w.system.eliminated_coupling, w.system.eliminated_gradient, w.system.step, b, p, i)
        sync()
    return 1
