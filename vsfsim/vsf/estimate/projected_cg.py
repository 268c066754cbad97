"""Large non-negative least squares by conjugate gradients on the free variables: for dense contact forces, where
neither side is small.

    minimise  1/2 |b - A x|^2 + 1/2 |x - x0|^2   subject to  x >= 0

Modified proportioning with reduced gradient projections (Dostal and Schoeberl 2005): conjugate gradient steps while
they stay feasible, a projected gradient step when they would become infeasible, and a step on the held variables when
their gradient outweighs that of the free ones. Only products with A and its transpose are needed. Variables are scaled
by the diagonal of the Hessian, which leaves the bound in place.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

_PROPORTION = 1.0
"""Ratio of the held to the free gradient beyond which held variables are released; the authors' choice."""


def projected_cg(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, *, start: np.ndarray, tolerance: float = 1e-7,
                 steps: int = 5000) -> tuple[np.ndarray, int]:
    """The minimiser (n,) and the number of products with A^T A.

    Args:
        a: (m, n).
        b: (m,).
        x0: (n,).
        start: initial guess (n,), negative entries count as 0.
        tolerance: norm of the projected gradient at which to stop, over that of A^T b + x0.
        steps: limit of products.
    """
    scale = 1.0 / np.sqrt(1.0 + np.asarray(a.multiply(a).sum(axis=0)).ravel())
    a = sparse.csr_matrix(a @ sparse.diags_array(scale))
    at, ridge = sparse.csr_matrix(a.T), scale**2
    right = at @ b + scale * x0

    def times(v: np.ndarray) -> np.ndarray:
        return at @ (a @ v) + ridge * v

    y = np.maximum(start, 0.0) / scale
    goal = tolerance * max(float(np.linalg.norm(right)), 1e-300)
    # Length of a projected gradient step: safe under 2 over the largest eigenvalue.
    v = np.ones(len(y)) / np.sqrt(max(len(y), 1))
    for _ in range(10):
        v = times(v)
        largest = float(np.linalg.norm(v))
        v /= max(largest, 1e-300)
    length = 1.0 / max(largest, 1e-300)
    gradient = times(y) - right
    count = 11
    free, held = _parts(y, gradient)
    direction = free.copy()
    while count < steps and free @ free + held @ held > goal * goal:
        if held @ held <= _PROPORTION**2 * _reduced(y, free, length) @ free:
            image = times(direction)
            count += 1
            best = float(direction @ gradient) / max(float(direction @ image), 1e-300)
            falling = direction > 0.0
            feasible = float(np.min(y[falling] / direction[falling])) if falling.any() else np.inf
            if best <= feasible:
                y, gradient = y - best * direction, gradient - best * image
                y = np.maximum(y, 0.0)
                free, held = _parts(y, gradient)
                direction = free - float(free @ image) / max(float(direction @ image), 1e-300) * direction
                continue
            y, gradient = np.maximum(y - feasible * direction, 0.0), gradient - feasible * image
            free, _ = _parts(y, gradient)
            y = np.maximum(y - length * free, 0.0)
            gradient = times(y) - right
            count += 1
        else:
            image = times(held)
            count += 1
            step = float(held @ gradient) / max(float(held @ image), 1e-300)
            y, gradient = y - step * held, gradient - step * image
        free, held = _parts(y, gradient)
        direction = free.copy()
    return y * scale, count


def _parts(y: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient on the free variables, and its negative part on the held ones, which releases them."""
    held = y <= 0.0
    return np.where(held, 0.0, gradient), np.where(held, np.minimum(gradient, 0.0), 0.0)


def _reduced(y: np.ndarray, free: np.ndarray, length: float) -> np.ndarray:
    """The free gradient, limited where a step of ``length`` along it would cross the bound."""
    return np.minimum(y / length, free)
