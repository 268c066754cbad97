"""Exact non-negative least squares with a prior, by principal pivoting.

    minimise  1/2 |b - A x|^2 + 1/2 |x - x0|^2   subject to  x >= 0

The dual has one unknown for each row: x = max(0, x0 + A^T y), and y minimises the convex, piecewise quadratic function
1/2 |y|^2 - b y + 1/2 |max(0, x0 + A^T y)|^2. On a face, that is for a given set F of free unknowns, both sides give the
same point,

    x_F = x0_F + (1 + A_F^T A_F)^-1 A_F^T (b - A x0)      y = (1 + A_F A_F^T)^-1 (b - A_F x0_F) = b - A x

so the smaller one is factorised, or a sparse A^T A where no side is small. Block principal pivoting exchanges all
unknowns of the wrong sign at once, a free x_i < 0 and a held x0_i + a_i y > 0 (Portugal, Judice and Vicente 1994). It
starts with all unknowns free and takes few steps where the readings do not outweigh the prior by much. It may cycle; a
step of it is a Newton step of the dual at its full length, so an exact line search makes it converge in finitely many
steps (semi-smooth Newton). Where the readings outweigh the prior by many orders, as in the truth of a dataset, the
minimiser is approached by raising their weight in stages; without these the same steps end far away.

The normal equations square the condition of A. Solutions on a face are therefore refined with residuals through A
itself (corrected seminormal equations, Bjorck 1987), and beyond `_CHOLESKY_LIMIT` a face is solved by an orthogonal
factorisation that never squares A.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

_SQUARE = 2
"""Unknowns a row up to which the unknowns' side is factorised."""
_STEPS = 60
"""Limit of block exchanges; the line search has more."""
_NEWTON_STEPS = 200
"""Limit of steps at one weight of the readings."""
_EXACT_STEPS = 20
"""The same with orthogonal factorisations, each of which may take seconds."""
_PATIENCE = 4
"""Block exchanges without a smaller number of wrong signs after which the line search takes over."""
_STALLED = 12
"""Newton steps without a smaller residual after which only rounding is left."""
_REFINEMENTS = 3
_ROUNDING = 1e-13
"""Signs of quantities below this fraction of the largest are rounding errors."""
GOOD = 1e-9
"""KKT residual that needs no orthogonal factorisation."""
_DENSE = 4000
"""Smaller side up to which nothing sparse is looked for (a dense factor takes 130 MB and seconds a step)."""
_PRODUCTS = 1e9
"""Multiplications that A^T A may take where it is looked at."""
_SPARSE = 0.15
"""Share of its entries up to which it counts as sparse."""
_CHOLESKY_LIMIT = 1e14
"""Largest eigenvalue of A A^T for which the normal equations are factorised: float64 holds 1 beside it."""
_FIRST_STAGE, _RAISE, _STAGE_TOLERANCE = 1e6, 10.0, 1e-4
"""Largest eigenvalue at the first stage, its factor from stage to stage, and the KKT residual of a stage."""


def kkt_residual(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, x: np.ndarray, scale: np.ndarray) -> float:
    """Residual of the optimality conditions [-]: the largest change that a projected Newton step in one unknown alone
    makes, over the largest of x, x0 and that change; all times ``scale`` (n,)."""
    gradient = a.T @ (a @ x - b) + x - x0
    diagonal = 1.0 + np.asarray(a.multiply(a).sum(axis=0)).ravel()
    change = scale * np.abs(x - np.maximum(x - gradient / diagonal, 0.0))
    largest = max(float(np.max(scale * np.abs(x))), float(np.max(scale * np.abs(x0))), float(np.max(change)), 1e-300)
    return float(np.max(change)) / largest


def principal_pivoting(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, *, scale: np.ndarray,
                       tolerance: float = 1e-11) -> np.ndarray:
    """Minimise 1/2 |b - A x|^2 + 1/2 |x - x0|^2 subject to x >= 0.

    Args:
        a: (m, n).
        b: (m,).
        x0: (n,).
        scale: units of the unknowns in the KKT residual (n,).
        tolerance: KKT residual at which to stop.

    Returns:
        The minimiser (n,).
    """
    problem = _Problem(a, b, x0, scale)
    free = np.ones(len(x0), bool)
    found = _block_exchanges(problem, free, _STEPS)[0]
    if problem.residual(found) <= max(tolerance, GOOD):
        return found
    strength = max(_largest_eigenvalue(a), 1e-300)
    stages, weight = [], _FIRST_STAGE
    while weight < 0.1 * strength:
        stages.append(weight)
        weight *= _RAISE
    y, before = np.zeros(len(b)), 1.0
    for stage in [*stages, strength]:
        last = stage == strength
        share = 1.0 if last else float(np.sqrt(stage / strength))
        weighted = _Problem(a * share, b * share, x0, scale, exact=stage > _CHOLESKY_LIMIT)
        # The same x = x0 + (share A)^T y at the new weight.
        x, y = _newton(weighted, free, y * (before / share), tolerance if last else _STAGE_TOLERANCE)
        free, before = x > 0.0, share
    if problem.residual(x) > GOOD and problem.sparse is None:
        x = _newton(_Problem(a, b, x0, scale, exact=True), free, y, tolerance)[0]
    return min((found, x), key=problem.residual)


class _Problem:
    """A, b and x0, and the solution on a face; by orthogonal factorisations if ``exact``."""

    def __init__(self, a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, scale: np.ndarray, *, exact: bool = False):
        self.a, self.at, self.columns = a, sparse.csr_matrix(a.T), a.tocsc()
        self.b, self.x0, self.scale, self.exact = b, x0, scale, exact
        self.right = self.at @ b + x0
        self.sparse = None if exact or min(a.shape) <= _DENSE else _sparse_hessian(a)
        self.by_unknowns = self.sparse is not None or a.shape[1] <= _SQUARE * a.shape[0]
        if self.by_unknowns and self.sparse is None and not exact:
            self.hessian = (self.at @ a).toarray()
            self.hessian[np.diag_indices_from(self.hessian)] += 1.0

    def residual(self, x: np.ndarray) -> float:
        return kkt_residual(self.a, self.b, self.x0, x, self.scale)

    def face(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x (n,), which may be negative, and y (m,) for the unknowns ``free``, the others held at 0."""
        x, inside = np.zeros(len(self.x0)), np.flatnonzero(free)
        if len(inside) == 0:
            return x, self.b.copy()
        if not self.exact:
            try:
                return self._by_unknowns(x, inside) if self.by_unknowns else self._by_rows(x, inside)
            except linalg.LinAlgError:  # rounding made the normal equations indefinite
                pass
        x[inside] = _least_squares(self.columns[:, inside].toarray(), self.b, self.x0[inside])
        return x, self.b - self.a @ x

    def _by_unknowns(self, x: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        solve = self._factored(inside)
        x[inside] = solve(self.right[inside])
        for _ in range(_REFINEMENTS):
            miss = (self.at @ (self.b - self.a @ x) + self.x0 - x)[inside]
            x[inside] += solve(miss)
        return x, self.b - self.a @ x

    def _factored(self, inside: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """What solves with 1 + A^T A of the unknowns ``inside``."""
        if self.sparse is not None:
            return splu(self.sparse[inside][:, inside], permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                        options={"SymmetricMode": True}).solve
        matrix = self.hessian[np.ix_(inside, inside)] if len(inside) < len(self.x0) else self.hessian
        dense = linalg.cho_factor(matrix, lower=True, check_finite=False)
        return lambda right: linalg.cho_solve(dense, right, check_finite=False)

    def _by_rows(self, x: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part = self.columns[:, inside]
        transposed = sparse.csr_matrix(part.T)
        matrix = (part @ transposed).toarray()
        matrix[np.diag_indices_from(matrix)] += 1.0
        factor = linalg.cho_factor(matrix, lower=True, overwrite_a=True, check_finite=False)
        y = np.zeros(len(self.b))
        for _ in range(1 + _REFINEMENTS):
            miss = self.b - part @ (self.x0[inside] + transposed @ y) - y
            y = y + linalg.cho_solve(factor, miss, check_finite=False)
        x[inside] = self.x0[inside] + transposed @ y
        return x, y


def _sparse_hessian(a: sparse.csr_matrix) -> sparse.csc_matrix | None:
    """1 + A^T A (n, n); None if it is not sparse, or if finding out would take long."""
    count = np.diff(a.indptr).astype(np.float64)
    if count @ count > _PRODUCTS:
        return None
    found = sparse.csc_matrix(a.T @ a + sparse.identity(a.shape[1]))
    return found if found.nnz <= _SPARSE * a.shape[1] ** 2 else None


def _block_exchanges(problem: _Problem, free: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """A feasible point and its y, from the free unknowns ``free``; the point is the minimiser
    unless the exchanges cycled or reached the limit."""
    fewest, patience, free = len(free) + 1, _PATIENCE, free.copy()
    rounding = _ROUNDING * float(np.abs(problem.right).max())
    for step in range(limit):
        x, y = problem.face(free)
        pull = problem.at @ y + problem.x0 - x
        wrong = np.where(free, x < -_ROUNDING * np.abs(x).max(), pull > rounding)
        number = int(np.count_nonzero(wrong))
        patience = _PATIENCE if number < fewest else patience - 1
        fewest = min(fewest, number)
        if number == 0 or patience == 0 or step == limit - 1:
            break
        free ^= wrong
    return np.maximum(x, 0.0), y


def _newton(problem: _Problem, free: np.ndarray, y: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Block exchanges from the free unknowns ``free``; if they cycle, Newton steps with a line search from ``y``.
    Returns x and y."""
    limit = _EXACT_STEPS if problem.exact else _NEWTON_STEPS
    x, target = _block_exchanges(problem, free, min(limit, _STEPS))
    best, best_residual = (x, target), problem.residual(x)
    if best_residual <= tolerance:
        return best
    patience = _STALLED
    for _ in range(limit):
        if patience == 0 or best_residual <= tolerance:
            break
        pull = problem.x0 + problem.at @ y
        direction = problem.face(pull > 0.0)[1] - y
        length = _line_search(pull, problem.at @ direction, y, direction, problem.b)
        moved = y + length * direction
        if np.array_equal(moved, y):
            break
        y = moved
        x = np.maximum(problem.x0 + problem.at @ y, 0.0)
        residual = problem.residual(x)
        # Far from the minimiser the residual may rise while the dual falls; near it, an end of its fall is rounding.
        patience = _STALLED if residual < best_residual or best_residual > 1e-5 else patience - 1
        if residual < best_residual:
            best, best_residual = (x, y), residual
    return best


def _line_search(p: np.ndarray, q: np.ndarray, y: np.ndarray, d: np.ndarray, b: np.ndarray) -> float:
    """The exact minimiser t >= 0 of the dual along d: 1/2 |y + t d|^2 - b.(y + t d) + 1/2 |max(0, p + t q)|^2.

    Its slope rises piecewise linearly, with a kink where a component of p + t q changes sign.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        kink = np.where(q != 0.0, -p / q, -1.0)
    order = np.flatnonzero(kink > 0.0)
    order = order[np.argsort(kink[order], kind="stable")]
    kinks = kink[order]
    inside = (p > 0.0) | ((p == 0.0) & (q > 0.0))
    constant = float(d @ (y - b)) + float(p[inside] @ q[inside])
    linear = float(d @ d) + float(q[inside] @ q[inside])
    # Past its kink a component leaves (q < 0) or joins (q > 0) the sum.
    sign = np.sign(q[order])
    constants = constant + np.concatenate([[0.0], np.cumsum(sign * p[order] * q[order])])
    linears = linear + np.concatenate([[0.0], np.cumsum(sign * q[order] ** 2)])
    ends = np.concatenate([kinks, [np.inf]])
    last = np.isinf(ends)
    root = np.argmax(np.where(last, np.inf, constants + linears * np.where(last, 0.0, ends)) >= 0.0)
    start = 0.0 if root == 0 else kinks[root - 1]
    return float(np.clip(-constants[root] / max(linears[root], 1e-300), start, ends[root]))


def _least_squares(a: np.ndarray, b: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Minimiser of |b - A x|^2 + |x - x0|^2, by Householder QR on the smaller side, without A^T A."""
    m, n = a.shape
    rest = b - a @ x0
    if n <= m:
        q, r = linalg.qr(np.concatenate([a, np.eye(n)]), mode="economic")
        return x0 + linalg.solve_triangular(r, q[:m].T @ rest)
    # x - x0 lies in the range of A^T = Q R: m unknowns.
    q, r = linalg.qr(a.T, mode="economic")
    q2, r2 = linalg.qr(np.concatenate([r.T, np.eye(m)]), mode="economic")
    return x0 + q @ linalg.solve_triangular(r2, q2[:m].T @ rest)


def _largest_eigenvalue(a: sparse.csr_matrix) -> float:
    """Largest eigenvalue of A A^T to a factor of about two, by power iteration from the row sums (deterministic)."""
    v = np.ones(a.shape[1]) + 1e-3 * np.arange(a.shape[1]) / a.shape[1]
    value = 0.0
    for _ in range(8):
        v /= np.linalg.norm(v)
        v = a.T @ (a @ v)
        value = float(np.linalg.norm(v))
        if value == 0.0:
            return 0.0
    return value
