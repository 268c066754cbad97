"""Shape functions of the ten-node tetrahedron: on the host anywhere, and at its four Gauss points in kernels.

The derivatives of a quadratic field by the barycentric coordinates are linear in the element. With their values T_k at
the corners they are far (T_0 + .. + T_3) + (near - far) T_q at Gauss point q. The sum is computed once per element, and
the second term is short.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.runtime import mat33, real

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

    ``edge_sums`` and ``gradient`` compute the displacement gradient at a Gauss point from the nodal values of an
    element (10, 3), in two steps. ``stresses``, ``spread`` and ``finish`` are the transpose: they turn a stress at each
    Gauss point into nodal forces.
    """
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat103 = wp.types.matrix(shape=(10, 3), dtype=real)
    far4 = wp.constant(real(4.0 * GAUSS_FAR))
    h = wp.constant(real(GAUSS_NEAR - GAUSS_FAR))
    h3 = wp.constant(real(3.0 * (GAUSS_NEAR - GAUSS_FAR)))
    h4 = wp.constant(real(4.0 * (GAUSS_NEAR - GAUSS_FAR)))
    node = {frozenset(edge): 4 + e for e, edge in enumerate(EDGES.tolist())}
    between = wp.constant(wp.types.matrix(shape=(4, 4), dtype=wp.int32)(
        [[node.get(frozenset((q, k)), q) for k in range(4)] for q in range(4)]))  # node of the edge of two corners

    @wp.func(module=module)
    def edge_sums(x: mat103):
        # For every corner, 4 far times the sum of its three edge nodes.
        return far4 * wp.matrix_from_rows(x[4] + x[6] + x[7], x[4] + x[5] + x[8], x[5] + x[6] + x[9],
                                          x[7] + x[8] + x[9])

    @wp.func(module=module)
    def gradient(x: mat103, s: mat43, g: mat33, q: int):
        # displacement gradient at Gauss point q; g: gradients of barycentric coordinates 1..3
        t = mat43()
        for k in range(4):
            if k == q:
                t[k] = h3 * x[k] + s[k]
            else:
                t[k] = h4 * x[between[q, k]] - h * x[k] + s[k]
        return wp.outer(t[1] - t[0], g[0]) + wp.outer(t[2] - t[0], g[1]) + wp.outer(t[3] - t[0], g[2])

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
        for k in range(4):
            if k == q:
                f[k] += h3 * t[k]
            else:
                f[k] -= h * t[k]
                f[between[q, k]] += h4 * t[k]
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

    return SimpleNamespace(edge_sums=edge_sums, gradient=gradient, stresses=stresses, spread=spread, finish=finish)
