"""Large non-negative least squares by conjugate gradients on the free variables: for dense contact forces, where
neither side is small.

    minimise  1/2 |b - A x|^2 + 1/2 |x - x0|^2   subject to  x >= 0

Modified proportioning with reduced gradient projections (Dostal and Schoeberl 2005): conjugate gradient steps while
they stay feasible, a projected gradient step when they would become infeasible, and a step on the held variables when
their gradient outweighs that of the free ones. Only products with A and its transpose are needed. Variables are scaled
by the diagonal of the Hessian, which leaves the bound in place.

This method finds the held variables a few at a time. Where A^T A can be formed, block principal pivoting (Portugal,
Judice and Vicente 1994) with inexact solves finds most of them first: conjugate gradients on a face without the bound,
then every negative variable is held and every held one with a negative gradient is released, and each face is solved
more accurately than the one before. The exact method starts from the result.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

_PROPORTION = 1.0
"""Ratio of the held to the free gradient beyond which held variables are released; the authors' choice."""
_FACES, _PATIENCE, _TIGHTER = 40, 5, 0.01
"""Limit of faces, limit of faces without a smaller number of wrong signs, and residual of a face over its first one."""
_GATHER = 60.0
"""Mean entries of a row, weighted by entries, up to which A^T A is formed: it costs that many products with A."""


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

    # The readings of many frames share few pairs of particles, so A^T A is formed once; dense rows would fill it.
    entries = np.diff(a.indptr).astype(float)
    gathered = sparse.csr_matrix(at @ a) if float((entries**2).sum()) < _GATHER * max(a.nnz, 1) else None

    def times(v: np.ndarray) -> np.ndarray:
        return (at @ (a @ v) if gathered is None else gathered @ v) + ridge * v

    y = np.maximum(start, 0.0) / scale
    goal = tolerance * max(float(np.linalg.norm(right)), 1e-300)
    guessed = 0
    if gathered is not None:
        y, guessed = _guess(gathered, ridge, right, y, goal)
    # Length of a projected gradient step: safe under 2 over the largest eigenvalue.
    v = np.ones(len(y)) / np.sqrt(max(len(y), 1))
    for _ in range(10):
        v = times(v)
        largest = float(np.linalg.norm(v))
        v /= max(largest, 1e-300)
    length = 1.0 / max(largest, 1e-300)
    gradient = times(y) - right
    count = 11 + guessed
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


def _guess(gathered: sparse.csr_matrix, ridge: np.ndarray, right: np.ndarray, y: np.ndarray,
           goal: float) -> tuple[np.ndarray, int]:
    """A feasible point, usually near the minimiser, by block principal pivoting; and the number of products."""
    gradient = gathered @ y + ridge * y - right
    inside, count, best, fewest, patience = (y > 0.0) | (gradient < 0.0), 1, y, len(y) + 1, _PATIENCE
    for _ in range(_FACES):
        face = np.flatnonzero(inside)
        part = gathered[face][:, face]
        x, steps = _face(part, ridge[face], right[face], y[face], goal)
        y = np.zeros(len(y))
        y[face] = x
        gradient = gathered @ y + ridge * y - right
        count += steps + 1
        wrong = np.where(inside, y < 0.0, gradient < 0.0)
        number = int(np.count_nonzero(wrong))
        if number < fewest:
            best, fewest, patience = np.maximum(y, 0.0), number, _PATIENCE
        else:
            patience -= 1
        free, held = _parts(np.maximum(y, 0.0), gradient)
        if (number == 0 and free @ free + held @ held <= goal * goal) or patience == 0:
            break
        inside ^= wrong
    return best, count


def _face(part: sparse.csr_matrix, ridge: np.ndarray, right: np.ndarray, y: np.ndarray,
          goal: float) -> tuple[np.ndarray, int]:
    """Conjugate gradients from ``y`` to `_TIGHTER` of the first residual, or half of the goal; and the number of
    products."""
    residual = right - part @ y - ridge * y
    direction, size, count = residual.copy(), float(residual @ residual), 1
    enough = max(_TIGHTER * size**0.5, 0.5 * goal) ** 2
    while size > enough and count < 2 * len(y) + 10:
        image = part @ direction + ridge * direction
        count += 1
        step = size / max(float(direction @ image), 1e-300)
        y, residual = y + step * direction, residual - step * image
        after = float(residual @ residual)
        direction, size = residual + after / size * direction, after
    return y, count


def _parts(y: np.ndarray, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient on the free variables, and its negative part on the held ones, which releases them."""
    held = y <= 0.0
    return np.where(held, 0.0, gradient), np.where(held, np.minimum(gradient, 0.0), 0.0)


def _reduced(y: np.ndarray, free: np.ndarray, length: float) -> np.ndarray:
    """The free gradient, limited where a step of ``length`` along it would cross the bound."""
    return np.minimum(y / length, free)
