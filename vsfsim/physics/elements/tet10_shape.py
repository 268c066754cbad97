"""Shape functions of the ten-node tetrahedron: on the host anywhere, and at its four Gauss points in kernels.

The derivatives of a quadratic field by the barycentric coordinates are linear in the element. With their values T_k at
the corners they are far (T_0 + .. + T_3) + (near - far) T_q at Gauss point q. The sum is computed once per element, and
the second term is short.
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
GAUSS = GAUSS_FAR + (GAUSS_NEAR - GAUSS_FAR) * np.eye(4)
"""Barycentric coordinates of the four Gauss points (4, 4) [-]."""


def shape_values(bary: np.ndarray) -> np.ndarray:
    """Values of the ten shape functions (k, 10) at barycentric coordinates (k, 4)."""
    return np.hstack([bary * (2.0 * bary - 1.0), 4.0 * bary[:, EDGES[:, 0]] * bary[:, EDGES[:, 1]]])


def shape_derivatives(bary: np.ndarray) -> np.ndarray:
    """Derivatives of the ten shape functions by the last three barycentric coordinates (k, 10, 3), where the first is
    one less their sum, at barycentric coordinates (k, 4)."""
    out = np.zeros((len(bary), 10, 4))
    out[:, np.arange(4), np.arange(4)] = 4.0 * bary - 1.0
    for e, (i, j) in enumerate(EDGES):
        out[:, 4 + e, i], out[:, 4 + e, j] = 4.0 * bary[:, j], 4.0 * bary[:, i]
    return out[:, :, 1:] - out[:, :, :1]


def jacobians(nodes: np.ndarray, bary: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of the positions by the last three barycentric coordinates (m, k, 3, 3) [m], rows by coordinate, of
    elements with ``nodes`` (m, 10, 3) [m] at barycentric coordinates (k, 4), and their determinants (m, k) [m^3], six
    times the volume where sides are straight."""
    out = np.einsum("kal,mac->mklc", shape_derivatives(bary), nodes)
    return out, (np.cross(out[:, :, 0], out[:, :, 1]) * out[:, :, 2]).sum(axis=2)


def shape_gradients(gradients: np.ndarray) -> np.ndarray:
    """Gradients of the shape functions at the Gauss points (m, 4, 10, 3) [1/m], from those of the last three
    barycentric coordinates there (m, 4, 3, 3)."""
    return np.einsum("qal,mqlc->mqac", shape_derivatives(GAUSS), gradients)


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
