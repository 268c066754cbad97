"""Small non-negative least squares with a prior, by block principal pivoting on the normal equations.

    minimise  1/2 |b - A x|^2 + 1/2 |x - x0|^2   subject to  x >= 0

H = A^T A + 1 is formed once, on as many rows as there are unknowns; where readings are many (contact forces on every
vertex of a sensor) that is all that is left of them. Each step solves for a set F of free unknowns and exchanges every
unknown that has the wrong sign: x_i < 0 in F, or a pull (H x - c)_i < 0 outside (Portugal, Judice and Vicente 1994).
When the number of wrong ones has not fallen for a while only the last of them is exchanged, which ends for any positive
definite H (Murty 1974). H squares the condition of A, so each solution is refined with residuals taken through A itself
(corrected seminormal equations, Bjorck 1987).
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, sparse

_STEPS = 60
# Exchanges of all wrong unknowns without their number falling, before one at a time.
_PATIENCE = 4
_REFINEMENTS = 3
# Signs of quantities under this fraction of the largest are rounding.
_ROUNDING = 1e-13


def pivoted(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, int] | None:
    """The minimiser (n,) and the number of steps; None if rounding or the limit of steps kept it from the solution.

    Args:
        a: (m, n) with n so small that an n x n matrix may be made. b: (m,). x0: (n,).
    """
    at = sparse.csr_matrix(a.T)
    hessian = (at @ a).toarray()
    hessian[np.diag_indices_from(hessian)] += 1.0
    right = at @ b + x0
    free = np.ones(len(x0), bool)
    fewest, patience = len(x0) + 1, _PATIENCE
    for step in range(1, _STEPS + 1):
        x = np.zeros(len(x0))
        if free.any():
            inside = np.flatnonzero(free)
            try:
                factor = linalg.cho_factor(hessian[np.ix_(inside, inside)] if len(inside) < len(x0) else hessian,
                                           lower=True, check_finite=False)
            except linalg.LinAlgError:
                return None
            x[inside] = linalg.cho_solve(factor, right[inside], check_finite=False)
            for _ in range(_REFINEMENTS):
                miss = (at @ (b - a @ x) + x0 - x)[inside]
                x[inside] += linalg.cho_solve(factor, miss, check_finite=False)
        pull = at @ (b - a @ x) + x0 - x
        wrong = np.flatnonzero(np.where(free, x < -_ROUNDING * np.abs(x).max(), pull > _ROUNDING * np.abs(right).max()))
        if len(wrong) == 0:
            return np.maximum(x, 0.0), step
        if len(wrong) < fewest:
            fewest, patience = len(wrong), _PATIENCE
        else:
            patience -= 1
        free[wrong if patience > 0 else wrong[-1:]] ^= True
    return None
