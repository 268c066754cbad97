"""The most probable stiffnesses of a VSF from its readings: the quadratic program of SBML eq. 16 with K >= 0.

    minimise  1/2 |(z - W K) / s|^2 + 1/2 |(K - mu) / sqrt(v)|^2   subject to  K >= 0

With x = K / sqrt(v), A = diag(1/s) W diag(sqrt(v)) and b = z / s it reads 1/2 |b - A x|^2 + 1/2 |x - x0|^2, x >= 0.
`bounded_least_squares` solves that: exactly by principal pivoting while readings or touched particles are few enough
for a dense matrix, or A^T A is sparse (`pivoting`), else by conjugate gradients (`projected_cg`, for dense contact
forces, where neither side is small).

The latter is modified proportioning with reduced gradient projections (Dostal and Schoeberl 2005): conjugate gradient
steps while they stay feasible, a projected gradient step when they would become infeasible, and a step on the held
variables when their gradient outweighs that of the free ones. Only products with A and its transpose are needed.
Variables are scaled by the diagonal of the Hessian, which leaves the bound in place.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.pivoting import GOOD, SparseGram, kkt_residual, principal_pivoting

_PROPORTION = 1.0
"""Ratio of the held to the free gradient beyond which held variables are released; the authors' choice."""
_DENSE_LIMIT = 4000
"""Smaller side beyond which no dense matrix is made (its factor would take 130 MB and seconds a step)."""


@dataclass(frozen=True)
class MapResult:
    """The maximum a posteriori stiffnesses."""

    mean: np.ndarray
    """Stiffness of every particle, >= 0 (n,) [N/m] (the unit of z over that of W)."""
    iterations: int
    """Steps of principal pivoting, or products with A^T A of conjugate gradients."""
    kkt_residual: float
    """`pivoting.kkt_residual` in units of the stiffness [-]."""
    active: int
    """Particles that some reading touches and whose stiffness is not held at 0."""


def bounded_least_squares(a: sparse.csr_matrix, b: np.ndarray, x0: np.ndarray, *, scale: np.ndarray,
                          tolerance: float = 1e-11) -> tuple[np.ndarray, int]:
    """Minimise 1/2 |b - A x|^2 + 1/2 |x - x0|^2 subject to x >= 0.

    Args:
        a: (m, n).
        b: (m,).
        x0: (n,).
        scale: units of the unknowns in the KKT residual (n,).
        tolerance: KKT residual at which principal pivoting stops.

    Returns:
        The minimiser (n,) and the number of steps.
    """
    if min(a.shape) <= _DENSE_LIMIT:
        return principal_pivoting(a, b, x0, scale=scale, tolerance=tolerance)
    known = SparseGram.of(a)
    if known is not None:
        with suppress(linalg.LinAlgError):
            found, steps = principal_pivoting(a, b, x0, scale=scale, tolerance=tolerance, known=known)
            if kkt_residual(a, b, x0, found, scale) <= GOOD:
                return found, steps
    return projected_cg(a, b, x0, start=x0)


def map_estimate(w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
                 prior_mean: np.ndarray | float, prior_var: np.ndarray | float) -> MapResult:
    """Solve SBML eq. 16 for a diagonal Gaussian prior, at any number of particles.

    Args:
        w: observation matrix (m, n), dense or sparse, in the unit of z over that of the stiffness.
        z: readings (m,).
        noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
        prior_mean: of the stiffnesses (n,) or one number; may be negative, the estimate is not.
        prior_var: of the stiffnesses, > 0 (n,) or one number.

    Raises:
        VsfError: shapes that do not fit, values that are not finite, a variance or noise that is not positive.
    """
    w, z, noise, mean, var = _checked(w, z, noise_std, prior_mean, prior_var)
    scale = np.sqrt(var)
    touched = np.flatnonzero(np.diff(w.tocsc().indptr))
    read = np.flatnonzero(np.diff(w.indptr))
    out = np.maximum(mean, 0.0)
    if len(touched) == 0:
        return MapResult(out, 0, 0.0, 0)
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read][:, touched]
                          @ sparse.diags_array(scale[touched]))
    b, x0 = z[read] / noise[read], mean[touched] / scale[touched]
    x, steps = bounded_least_squares(a, b, x0, scale=scale[touched])
    out[touched] = scale[touched] * x
    return MapResult(out, steps, kkt_residual(a, b, x0, x, scale[touched]), int(np.count_nonzero(x > 0.0)))


def _checked(w: sparse.csr_matrix, z: np.ndarray, noise_std: np.ndarray | float,
             prior_mean: np.ndarray | float, prior_var: np.ndarray | float,
             ) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """W without stored zeros, z, and the noise and the prior for every reading and particle."""
    w = sparse.csr_matrix(w, dtype=np.float64, copy=True)
    w.sum_duplicates()
    w.eliminate_zeros()
    m, n = w.shape
    z = np.asarray(z, np.float64)
    if z.shape != (m,):
        raise VsfError(f"vsf.map_estimate: z has shape {z.shape}, but W is {m} x {n}; give one reading a row, ({m},).")
    values = []
    for name, value, size in (("noise_std", noise_std, m), ("prior_mean", prior_mean, n), ("prior_var", prior_var, n)):
        value = np.asarray(value, np.float64)
        if value.ndim and value.shape != (size,):
            raise VsfError(f"vsf.map_estimate: {name} has shape {value.shape}, but W is {m} x {n}; give one number "
                           f"or ({size},).")
        values.append(np.broadcast_to(value, (size,)).astype(np.float64))
    for name, value in zip(("W", "z", "noise_std", "prior_mean", "prior_var"), (w.data, z, *values)):
        if not np.isfinite(value).all():
            raise VsfError(f"vsf.map_estimate: {name} has {int((~np.isfinite(value)).sum())} values that are not "
                           f"finite; remove those readings or particles.")
    for name, value in (("noise_std", values[0]), ("prior_var", values[2])):
        if (value <= 0.0).any():
            raise VsfError(f"vsf.map_estimate: {name} goes down to {value.min():g}; it must be greater than 0.")
    return w, z, *values


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
