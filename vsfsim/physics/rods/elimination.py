"""Newton's step of a tree: elimination of 6 x 6 blocks from the tips to the root and back, which costs as many blocks as there are nodes."""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Trees, Work
from vsfsim.physics.rods.segment import ONE, ZERO, mat66, real

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.spatial_vectord


@wp.func(inline=False)
def cholesky(a: mat66):
    """Lower factor of a 6 x 6 block, and 1, or 0 where it is not positive definite."""
    out = mat66()
    fine = int(1)
    for j in range(6):
        d = a[j, j]
        for k in range(j):
            d = d - out[j, k] * out[j, k]
        if not d > real(1e-13) * wp.abs(a[j, j]):
            fine = 0
            d = ONE
        root = wp.sqrt(d)
        out[j, j] = root
        for i in range(j + 1, 6):
            v = a[i, j]
            for k in range(j):
                v = v - out[i, k] * out[j, k]
            out[i, j] = v / root
    return out, fine


@wp.func
def solve(tree: Trees, w: Work, b: int, o: int, count: int):
    """The step of all active nodes; ``w.step`` holds the right side before, the step after. 1, or 0 where the tangent is not positive definite."""
    for back in range(1, count):
        i = w.order[b, count - back]
        p = tree.parent[o + i]
        low, fine = cholesky(w.diagonal[b, i])
        if fine == 0:
            return 0
        y = w.coupling[b, i]
        r = w.step[b, i]
        for k in range(6):
            inverse = ONE / low[k, k]
            for c in range(6):
                v = y[k, c]
                for m in range(k):
                    v = v - low[k, m] * y[m, c]
                y[k, c] = v * inverse
            v6 = r[k]
            for m in range(k):
                v6 = v6 - low[k, m] * r[m]
            r[k] = v6 * inverse
        w.diagonal[b, i] = low
        w.coupling[b, i] = y
        w.step[b, i] = r
        if p > 0:
            yt = wp.transpose(y)
            w.diagonal[b, p] = w.diagonal[b, p] - yt * y
            w.step[b, p] = w.step[b, p] - yt * r
    w.step[b, 0] = vec6()
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        low = w.diagonal[b, i]
        r = w.step[b, i] - w.coupling[b, i] * w.step[b, p]
        for up in range(6):
            k = 5 - up
            v = r[k]
            for m in range(k + 1, 6):
                v = v - low[m, k] * r[m]
            r[k] = v / low[k, k]
        w.step[b, i] = r
    return 1


@wp.func
def solve_coulomb(tree: Trees, w: Work, b: int, o: int, count: int):
    """As `solve`, for a tangent that is not symmetric: Gauss's elimination with pivots within the blocks. 1, or 0 where a pivot is lost."""
    for back in range(1, count):
        i = w.order[b, count - back]
        p = tree.parent[o + i]
        d = w.diagonal[b, i]
        y = w.coupling[b, i]
        r = w.step[b, i]
        up = w.across[b, i]
        for k in range(6):
            best = k
            for m in range(k + 1, 6):
                if wp.abs(d[m, k]) > wp.abs(d[best, k]):
                    best = m
            if not wp.abs(d[best, k]) > ZERO:
                return 0
            if best != k:
                for c in range(6):
                    t = d[k, c]
                    d[k, c] = d[best, c]
                    d[best, c] = t
                    t = y[k, c]
                    y[k, c] = y[best, c]
                    y[best, c] = t
                t = r[k]
                r[k] = r[best]
                r[best] = t
            inverse = ONE / d[k, k]
            for m in range(k + 1, 6):
                f = d[m, k] * inverse
                if f != ZERO:
                    for c in range(k + 1, 6):
                        d[m, c] = d[m, c] - f * d[k, c]
                    for c in range(6):
                        y[m, c] = y[m, c] - f * y[k, c]
                    r[m] = r[m] - f * r[k]
        for low in range(6):
            k = 5 - low
            inverse = ONE / d[k, k]
            for m in range(k + 1, 6):
                f = d[k, m]
                for c in range(6):
                    y[k, c] = y[k, c] - f * y[m, c]
                r[k] = r[k] - f * r[m]
            for c in range(6):
                y[k, c] = y[k, c] * inverse
            r[k] = r[k] * inverse
        w.coupling[b, i] = y
        w.step[b, i] = r
        if p > 0:
            w.diagonal[b, p] = w.diagonal[b, p] - up * y
            w.step[b, p] = w.step[b, p] - up * r
    w.step[b, 0] = vec6()
    for a in range(1, count):
        i = w.order[b, a]
        w.step[b, i] = w.step[b, i] - w.coupling[b, i] * w.step[b, tree.parent[o + i]]
    return 1
