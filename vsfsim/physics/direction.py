"""One Newton direction for a batch of touches: elements and contact in the matrix, both answered by the preconditioner."""

from __future__ import annotations

import numpy as np
import warp as wp

from vsfsim.physics import pcg
from vsfsim.physics.elasticity import Elasticity
from vsfsim.physics.factor import RestFactor
from vsfsim.physics.touching import Touching


def newton_direction(elasticity: Elasticity, touching: Touching, factor: RestFactor, columns: np.ndarray, residual: np.ndarray, *,
                     near: np.ndarray, tolerance: np.ndarray, iterations: int) -> tuple[np.ndarray, int, np.ndarray, np.ndarray]:
    """Solve (tangent + contact) d = residual by `pcg`.

    Args:
        elasticity: with the tangent of ``columns`` made. touching: evaluated at the present state. factor: of the rest state.
        columns: touches (k,). residual: unbalanced forces (3 n, k) [N].
        near: whose contact counts with its geometric term (k,); deep inside the probe that term is large, and wrong.
        tolerance: relative residual of each column (k,). iterations: limit.

    Returns:
        Directions (3 n, k) [m]; iterations; who met negative curvature (k,) bool; the contact stiffness used (B, 3 s, 3 s) [N/m].
    """
    real, device = elasticity.real, elasticity.device
    kernels = pcg.kernels(real)
    count, batch = len(columns), len(touching.patches)
    index = wp.array(columns, dtype=wp.int32, device=device)
    width = 3 * touching.nodes.shape[1]
    stiff = np.zeros((batch, width, width))
    inverse = np.zeros((batch, width, width))
    for b, close in zip(columns, near, strict=True):
        rows, d, bend = touching.rows(b, geometric=bool(close))
        if len(rows):
            s = rows.shape[1]
            stiff[b, :s, :s] = rows.T @ (d[:, None] * rows) + bend
            small = rows @ touching.compliance(b) @ rows.T
            small[np.diag_indices_from(small)] += 1.0 / d
            inverse[b, :s, :s] = rows.T @ np.linalg.solve(small, rows)
    has_contact = bool(inverse.any())
    stiff_array = wp.array(stiff, dtype=real, device=device)
    inverse_array = wp.array(inverse, dtype=real, device=device)

    def patch(block: wp.array, sign: float, x: wp.array, y: wp.array) -> None:
        if has_contact:
            wp.launch(kernels.patch, dim=(width, count), device=device, inputs=[block, touching.nodes, index, sign, x, y])

    def multiply(x: wp.array) -> wp.array:
        out = elasticity.multiply(index, x)
        patch(stiff_array, 1.0, x, out)
        return out

    def back(x: wp.array) -> wp.array:
        return wp.array(factor.solve(x.numpy()), dtype=real, device=device)

    def precondition(r: wp.array) -> wp.array:
        if not has_contact:
            return back(r)
        y = back(r)
        r = wp.clone(r)
        patch(inverse_array, -1.0, y, r)
        return back(r)

    direction, steps, negative = pcg.solve(kernels, multiply, precondition, wp.array(residual, dtype=real, device=device),
                                           tolerance=tolerance, iterations=iterations)
    return direction.numpy().astype(np.float64), steps, negative, stiff
