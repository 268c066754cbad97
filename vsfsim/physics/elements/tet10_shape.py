"""Shape functions of the ten-node tetrahedron with straight sides: gradients at its four Gauss points, on the host and
in kernels.

The gradient of a quadratic field is linear in the element. With the barycentric derivatives T_k at the corners it is
far (T_0 + .. + T_3) + (near - far) T_q at Gauss point q. The sum is computed once per element, and the second term is
short.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.runtime import mat33, real, vec3

EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
"""Corners of the edges on which nodes 4 to 9 lie (6, 2); nodes 0 to 3 are the corners."""
GAUSS_NEAR = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0
"""Barycentric coordinate of a Gauss point for the corner nearest to it [-]."""
GAUSS_FAR = (5.0 - np.sqrt(5.0)) / 20.0
"""Barycentric coordinate of a Gauss point for each of the other three corners [-]."""


def shape_gradients(gradients: np.ndarray, q: int) -> np.ndarray:
    """Gradients of the shape functions at Gauss point ``q`` (m, 10, 3) [1/m], from those of the barycentric coordinates
    (m, 4, 3)."""
    bary = np.full(4, GAUSS_FAR)
    bary[q] = GAUSS_NEAR
    shape = np.zeros((10, 4))
    shape[np.arange(4), np.arange(4)] = 4.0 * bary - 1.0
    for e, (i, j) in enumerate(EDGES):
        shape[4 + e, i] = 4.0 * bary[j]
        shape[4 + e, j] = 4.0 * bary[i]
    return np.einsum("ak,mkc->mac", shape, gradients)


def functions(module: str) -> Any:
    """Device functions, compiled into ``module``.

    ``load`` reads the nodal values of an element (10, 3). ``edge_sums`` and ``gradient`` compute its displacement
    gradient at a Gauss point, in two steps. ``stresses``, ``spread`` and ``finish`` are the transpose: they turn a
    stress at each Gauss point into nodal forces.
    """
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat103 = wp.types.matrix(shape=(10, 3), dtype=real)
    far4 = wp.constant(real(4.0 * GAUSS_FAR))
    h = wp.constant(real(GAUSS_NEAR - GAUSS_FAR))
    h3 = wp.constant(real(3.0 * (GAUSS_NEAR - GAUSS_FAR)))
    h4 = wp.constant(real(4.0 * (GAUSS_NEAR - GAUSS_FAR)))

    @wp.func(module=module)
    def load(nodes: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=real), t: int, b: int):
        out = mat103()
        for a in range(10):
            row = 3 * nodes[t, a]
            for c in range(3):
                out[a, c] = x[row + c, b]
        return out

    @wp.func(module=module)
    def edge_sums(x: mat103):
        # For every corner, 4 far times the sum of its three edge nodes.
        return far4 * wp.matrix_from_rows(x[4] + x[6] + x[7], x[4] + x[5] + x[8], x[5] + x[6] + x[9],
                                          x[7] + x[8] + x[9])

    @wp.func(module=module)
    def gradient(x: mat103, s: mat43, g: mat33, q: int):
        # displacement gradient at Gauss point q; g: gradients of barycentric coordinates 1..3
        t0 = vec3()
        t1 = vec3()
        t2 = vec3()
        t3 = vec3()
        if q == 0:
            t0 = h3 * x[0]
            t1 = h4 * x[4] - h * x[1]
            t2 = h4 * x[6] - h * x[2]
            t3 = h4 * x[7] - h * x[3]
        elif q == 1:
            t0 = h4 * x[4] - h * x[0]
            t1 = h3 * x[1]
            t2 = h4 * x[5] - h * x[2]
            t3 = h4 * x[8] - h * x[3]
        elif q == 2:
            t0 = h4 * x[6] - h * x[0]
            t1 = h4 * x[5] - h * x[1]
            t2 = h3 * x[2]
            t3 = h4 * x[9] - h * x[3]
        else:
            t0 = h4 * x[7] - h * x[0]
            t1 = h4 * x[8] - h * x[1]
            t2 = h4 * x[9] - h * x[2]
            t3 = h3 * x[3]
        t0 = t0 + s[0]
        return wp.outer(t1 + s[1] - t0, g[0]) + wp.outer(t2 + s[2] - t0, g[1]) + wp.outer(t3 + s[3] - t0, g[2])

    @wp.func(module=module)
    def stresses(p: mat33, g: mat33):
        # The derivatives of the work of the stress p at a Gauss point by the four barycentric derivatives.
        a = p * g[0]
        b = p * g[1]
        c = p * g[2]
        return wp.matrix_from_rows(-(a + b + c), a, b, c)

    @wp.func(module=module)
    def spread(f: mat103, t: mat43, q: int):
        # The transpose of the terms of `gradient` that depend on q, added to f.
        if q == 0:
            f[0] += h3 * t[0]
            f[1] -= h * t[1]
            f[2] -= h * t[2]
            f[3] -= h * t[3]
            f[4] += h4 * t[1]
            f[6] += h4 * t[2]
            f[7] += h4 * t[3]
        elif q == 1:
            f[0] -= h * t[0]
            f[1] += h3 * t[1]
            f[2] -= h * t[2]
            f[3] -= h * t[3]
            f[4] += h4 * t[0]
            f[5] += h4 * t[2]
            f[8] += h4 * t[3]
        elif q == 2:
            f[0] -= h * t[0]
            f[1] -= h * t[1]
            f[2] += h3 * t[2]
            f[3] -= h * t[3]
            f[6] += h4 * t[0]
            f[5] += h4 * t[1]
            f[9] += h4 * t[3]
        else:
            f[0] -= h * t[0]
            f[1] -= h * t[1]
            f[2] -= h * t[2]
            f[3] += h3 * t[3]
            f[7] += h4 * t[0]
            f[8] += h4 * t[1]
            f[9] += h4 * t[2]
        return f

    @wp.func(module=module)
    def finish(f: mat103, t: mat43):
        # The transpose of `edge_sums`, for the sum t of the stresses over the Gauss points.
        s = far4 * t
        f[4] += s[0] + s[1]
        f[5] += s[1] + s[2]
        f[6] += s[0] + s[2]
        f[7] += s[0] + s[3]
        f[8] += s[1] + s[3]
        f[9] += s[2] + s[3]
        return f

    return SimpleNamespace(load=load, edge_sums=edge_sums, gradient=gradient, stresses=stresses, spread=spread,
                           finish=finish)
