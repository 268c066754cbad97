"""The most probable stiffnesses of a VSF from its readings: the quadratic program of SBML eq. 16 with K >= 0.

    minimise  1/2 |(z - W K) / s|^2 + 1/2 |(K - mu) / sqrt(v)|^2   subject to  K >= 0

With x = K / sqrt(v), A = diag(1/s) W diag(sqrt(v)) and b = z / s it reads 1/2 |b - A x|^2 + 1/2 |x - x0|^2, x >= 0. Its
dual has one unknown a reading: x = max(0, x0 + A^T y), and y solves F(y) = y + A max(0, x0 + A^T y) - b = 0, the
gradient of a convex, piecewise quadratic function. Semi-smooth Newton with an exact line search ends after finitely
many steps; the largest matrix is readings x readings. Where touched particles are not much more than readings, their
normal equations are cheaper, see
`pivoting`. Where both are many (dense contact forces) no matrix is formed at all, see `projected_cg`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.pivoting import pivoted
from vsfsim.vsf.estimate.projected_cg import projected_cg

# Largest eigenvalue of A A^T up to which the dual is trusted with the whole problem: beyond, the readings outweigh the
# prior by more than float64 can hold side by side, and rounding in y shows in x = x0 + A^T y.
_DUAL_LIMIT = 1e14
# Strengths at which the problem is solved on the way to its own, and how well.
_STAGES = tuple(1e6 * 30.0**k for k in range(6))
_STAGE_TOLERANCE = 1e-4
_MAX_STEPS = 200
# Budget of the primal in floating-point operations (about five minutes of one core), and its steps in any case.
_PRIMAL_WORK = 1e12
_PIVOTS = (20, 2000)
# Newton steps in a row without progress: what is left is rounding.
_PATIENCE = 12
# A KKT residual that needs no second algorithm.
_GOOD = 1e-9
# Smaller side beyond which no dense matrix is made (its factor would take 130 MB and seconds a step).
_DENSE_LIMIT = 4000
# Touched particles a reading up to which the particles' side is the cheaper one: it takes no detour over weaker
# readings.
_SQUARE = 2
# Columns of A that are dense at one time in `posterior_std`.
_BLOCK = 1024


@dataclass(frozen=True)
class MapResult:
    """The maximum a posteriori stiffnesses.

    mean: stiffness of every particle, >= 0 (n,) [N/m] (in the unit of z over that of W).
    iterations: Newton steps.
    kkt_residual: how far the optimality conditions are from holding: the largest change that a projected Newton step
        in one stiffness alone would still make, over the largest stiffness of mean and prior [-].
    active: particles that some reading touches and whose stiffness is not held at 0.
    """

    mean: np.ndarray
    iterations: int
    kkt_residual: float
    active: int


def map_estimate(w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
                 prior_mean: np.ndarray | float, prior_var: np.ndarray | float, tolerance: float = 1e-11) -> MapResult:
    """Solve SBML eq. 16 for a diagonal Gaussian prior, at any number of particles.

    Args:
        w: observation matrix (m, n); the unit of z over that of the stiffness. Dense or sparse.
        z: readings (m,).
        noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
        prior_mean: of the stiffnesses (n,) or one number; may be negative, the estimate is not.
        prior_var: of the stiffnesses, > 0 (n,) or one number.
        tolerance: on the KKT residual at which to stop.

    Raises:
        VsfError: shapes that do not fit, values that are not finite, a variance or noise that is not positive.
    """
    w, z, noise, mean, var = _checked("map_estimate", w, z, noise_std, prior_mean, prior_var)
    scale = np.sqrt(var)
    touched = np.flatnonzero(np.diff(w.tocsc().indptr))
    read = np.flatnonzero(np.diff(w.indptr))
    out = np.maximum(mean, 0.0)
    if len(touched) == 0:
        return MapResult(out, 0, 0.0, 0)
    a = sparse.diags_array(1.0 / noise[read]) @ w[read][:, touched] @ sparse.diags_array(scale[touched])
    a = sparse.csr_matrix(a)
    b, x0 = z[read] / noise[read], mean[touched] / scale[touched]
    if min(a.shape) > _DENSE_LIMIT:
        x, steps = projected_cg(a, b, x0, start=x0)
        out[touched] = scale[touched] * x
        return MapResult(out, steps, _kkt(a, b, x0, x, scale[touched]), int(np.count_nonzero(x > 0.0)))
    if a.shape[1] <= _SQUARE * a.shape[0] and a.shape[1] <= _DENSE_LIMIT:
        found = pivoted(a, b, x0)
        residual = np.inf if found is None else _kkt(a, b, x0, found[0], scale[touched])
        if found is not None and residual <= max(tolerance, _GOOD):
            out[touched] = scale[touched] * found[0]
            return MapResult(out, found[1], residual, int(np.count_nonzero(found[0] > 0.0)))
    if a.shape[1] < a.shape[0]:
        # More readings than unknowns: |b - A x| = |Q^T b - R x| + const, with R only touched x touched.
        q, r = linalg.qr(a.toarray(), mode="economic")
        a, b = sparse.csr_matrix(r), q.T @ b
    # A tight fit to the readings takes many steps from the prior: come to it by raising the readings' weight.
    strength = max(_largest_eigenvalue(a), 1e-300)
    stages = [t for t in _STAGES if t < 0.1 * min(strength, _DUAL_LIMIT)] + [min(strength, _DUAL_LIMIT)]
    x, y, steps, before = x0, np.zeros(len(b)), 0, 1.0
    for stage in stages:
        weight = 1.0 if stage == strength else float(np.sqrt(stage / strength))
        # The same x = x0 + (weight A)^T y at the new weight.
        x, y, more = _dual(a * weight, b * weight, x0, y * (before / weight), scale[touched],
                           tolerance if stage == stages[-1] else _STAGE_TOLERANCE)
        steps, before = steps + more, weight
    residual = _kkt(a, b, x0, x, scale[touched])
    if weight < 1.0 or residual > _GOOD:
        x, more = _primal(a, b, x0, x, scale[touched], tolerance)
        steps, residual = steps + more, _kkt(a, b, x0, x, scale[touched])
    out[touched] = scale[touched] * x
    return MapResult(out, steps, residual, int(np.count_nonzero(x > 0.0)))


def posterior_std(w: sparse.csr_matrix, *, noise_std: np.ndarray | float, prior_var: np.ndarray | float) -> np.ndarray:
    """Standard deviation of each stiffness under the Gaussian posterior, without K >= 0 (n,) [N/m].

    The diagonal of (V^-1 + W^T S^-1 W)^-1 by Woodbury's identity, on the smaller of readings and touched particles.
    A particle known to better than about 1e-7 of its prior (when there are fewer readings than touched particles)
    is reported at 1e-7, which is what float64 leaves of the difference.

    Args, Raises: as `map_estimate`.
    """
    w, _, noise, _, var = _checked("posterior_std", w, np.zeros(w.shape[0]), noise_std, 0.0, prior_var)
    out = np.sqrt(var)
    scale = out.copy()
    touched = np.flatnonzero(np.diff(w.tocsc().indptr))
    read = np.flatnonzero(np.diff(w.indptr))
    if len(touched) == 0:
        return out
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read][:,
                                                                          touched] @ sparse.diags_array(scale[touched]))
    if a.shape[1] <= a.shape[0]:
        factor = linalg.cholesky((a.T @ a).toarray() + np.eye(a.shape[1]), lower=True)
        inverse = linalg.solve_triangular(factor, np.eye(a.shape[1]), lower=True)
        left = np.einsum("ij,ij->j", inverse, inverse)
    else:
        factor = linalg.cholesky((a @ a.T).toarray() + np.eye(a.shape[0]), lower=True)
        columns, left = a.tocsc(), np.empty(a.shape[1])
        for start in range(0, a.shape[1], _BLOCK):
            block = linalg.solve_triangular(factor, columns[:, start:start + _BLOCK].toarray(), lower=True)
            left[start:start + _BLOCK] = 1.0 - np.einsum("ij,ij->j", block, block)
    out[touched] = scale[touched] * np.sqrt(np.maximum(left, 1e-14 if a.shape[1] > a.shape[0] else 0.0))
    return out


def _dual(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, y: np.ndarray, scale: np.ndarray,
          tolerance: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Semi-smooth Newton on the dual from ``y``; returns x, y and the number of steps."""
    at = sparse.csr_matrix(a.T)
    x = np.maximum(x0 + at @ y, 0.0)
    best, best_residual, patience = (x, y), np.inf, _PATIENCE
    for step in range(_MAX_STEPS):
        residual = _kkt(a, b, x0, x, scale)
        # Far from the solution the residual says nothing about progress (the line search does); near it, what no
        # longer falls is rounding.
        if residual < best_residual or best_residual > 1e-5:
            best, best_residual, patience = (x, y), residual, _PATIENCE
        else:
            patience -= 1
        if residual <= tolerance or patience == 0:
            return *best, step
        pull = x0 + at @ y
        inside = pull > 0.0
        gradient = y + a @ np.where(inside, pull, 0.0) - b
        part = a[:, inside]
        hessian = (part @ part.T).toarray()
        hessian[np.diag_indices_from(hessian)] += 1.0
        factor = linalg.cho_factor(hessian, lower=True, overwrite_a=True, check_finite=False)
        direction = -linalg.cho_solve(factor, gradient, check_finite=False)
        moved = y + _line_search(pull, at @ direction, y, direction, b) * direction
        if np.array_equal(moved, y):
            return *best, step + 1
        y = moved
        x = np.maximum(x0 + at @ y, 0.0)
    return *best, _MAX_STEPS


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
    root = np.argmax(np.where(np.isinf(ends), np.inf, constants + linears * np.where(np.isinf(ends), 0.0, ends)) >= 0.0)
    start = 0.0 if root == 0 else kinks[root - 1]
    return float(np.clip(-constants[root] / max(linears[root], 1e-300), start, ends[root]))


def _primal(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, x: np.ndarray, scale: np.ndarray,
            tolerance: float) -> tuple[np.ndarray, int]:
    """Active set on the primal (Lawson and Hanson 1974, with the prior's rows), each solve by orthogonal factorisation.

    Slower than the dual, one particle a step, but it never forms A A^T and every step lowers the cost: for a prior
    next to none. It starts from the feasible ``x``.
    """
    columns = a.tocsc()
    own = 1.0 + np.asarray(a.multiply(a).sum(axis=0)).ravel()
    free = x > 0.0
    best, best_residual = x, _kkt(a, b, x0, x, scale)
    blocked: set[int] = set()
    entered = -1
    work = 2.0 * min(a.shape) ** 2 * max(a.shape)
    step, limit = 0, int(np.clip(_PRIMAL_WORK / work, *_PIVOTS))
    while step < limit:
        step += 1
        goal = np.zeros_like(x)
        goal[free] = _least_squares(columns[:, free].toarray(), b, x0[free])
        leaving = np.flatnonzero(free & (goal <= 0.0))
        if len(leaving):
            # Go as far as the first that reaches 0, which leaves (rounding may make others reach it with that one).
            way = x[leaving] / np.maximum(x[leaving] - goal[leaving], 1e-300)
            length = float(np.clip(way.min(), 0.0, 1.0))
            x = np.maximum(x + length * (goal - x), 0.0)
            out = leaving[way <= length * (1.0 + 1e-12)]
            x[out], free[out] = 0.0, False
            if entered in out:
                # What came in goes straight out again: its pull was rounding.
                blocked.add(entered)
                entered = -1
            continue
        x = goal
        residual = _kkt(a, b, x0, x, scale)
        if residual < best_residual:
            best, best_residual, blocked = x, residual, set()
        if residual <= tolerance:
            break
        pull = scale * (a.T @ (b - a @ x) + x0 - x) / own
        pull[free] = 0.0
        pull[list(blocked)] = 0.0
        entered = int(np.argmax(pull))
        if pull[entered] <= 0.0:
            break
        free[entered] = True
    return best, step


def _least_squares(a: np.ndarray, b: np.ndarray, x0: np.ndarray) -> np.ndarray:
    """Minimiser of |b - A x|^2 + |x - x0|^2, by Householder QR on the smaller side, never squaring A."""
    m, n = a.shape
    rest = b - a @ x0
    if n <= m:
        q, r = linalg.qr(np.concatenate([a, np.eye(n)]), mode="economic")
        return x0 + linalg.solve_triangular(r, q[:m].T @ rest)
    # x - x0 lies in the range of A^T = Q R: m unknowns.
    q, r = linalg.qr(a.T, mode="economic")
    q2, r2 = linalg.qr(np.concatenate([r.T, np.eye(m)]), mode="economic")
    return x0 + q @ linalg.solve_triangular(r2, q2[:m].T @ rest)


def _kkt(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, x: np.ndarray, scale: np.ndarray) -> float:
    gradient = a.T @ (a @ x - b) + x - x0
    own = 1.0 + np.asarray(a.multiply(a).sum(axis=0)).ravel()
    change = np.abs(x - np.maximum(x - gradient / own, 0.0))
    largest = max(float(np.max(scale * np.abs(x))), float(np.max(scale * np.abs(x0))), float(np.max(scale * change)),
                  1e-300)
    return float(np.max(scale * change)) / largest


def _largest_eigenvalue(a: sparse.csr_matrix) -> float:
    """Of A A^T, to a factor of about two and deterministic: power iteration from the row sums."""
    v = np.ones(a.shape[1]) + 1e-3 * np.arange(a.shape[1]) / a.shape[1]
    value = 0.0
    for _ in range(8):
        v /= np.linalg.norm(v)
        v = a.T @ (a @ v)
        value = float(np.linalg.norm(v))
        if value == 0.0:
            return 0.0
    return value


def _checked(where: str, w: sparse.csr_matrix, z: np.ndarray, noise_std: np.ndarray | float,
             prior_mean: np.ndarray | float,
             prior_var: np.ndarray | float) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    w = sparse.csr_matrix(w, dtype=np.float64, copy=True)
    w.sum_duplicates()
    w.eliminate_zeros()
    m, n = w.shape
    z = np.asarray(z, np.float64)
    if z.shape != (m,):
        raise VsfError(f"vsf.{where}: z has shape {z.shape}, but W is {m} x {n}; give one reading a row, ({m},).")
    values = []
    for name, value, size in (("noise_std", noise_std, m), ("prior_mean", prior_mean, n), ("prior_var", prior_var, n)):
        value = np.asarray(value, np.float64)
        if value.ndim and value.shape != (size,):
            raise VsfError(f"vsf.{where}: {name} has shape {value.shape}, but W is {m} x {n}; give one number "
                           f"or ({size},).")
        values.append(np.broadcast_to(value, (size,)).astype(np.float64))
    for name, value in zip(("W", "z", "noise_std", "prior_mean", "prior_var"), (w.data, z, *values)):
        if not np.isfinite(value).all():
            raise VsfError(f"vsf.{where}: {name} has {int((~np.isfinite(value)).sum())} values that are not finite; "
                           f"remove those readings or particles.")
    for name, value in (("noise_std", values[0]), ("prior_var", values[2])):
        if (value <= 0.0).any():
            raise VsfError(f"vsf.{where}: {name} goes down to {value.min():g}; it must be greater than 0.")
    return w, z, *values
