"""The most probable stiffnesses of a VSF from its readings: the quadratic program of SBML eq. 16 with K >= 0.

    minimise  1/2 |(z - W K) / s|^2 + 1/2 |(K - mu) / sqrt(v)|^2   subject to  K >= 0

With x = K / sqrt(v), A = diag(1/s) W diag(sqrt(v)) and b = z / s it reads 1/2 |b - A x|^2 + 1/2 |x - x0|^2, x >= 0.
Principal pivoting solves that (`pivoting`).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.pivoting import principal_pivoting


def map_estimate(w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
                 prior_mean: np.ndarray | float, prior_var: np.ndarray | float) -> np.ndarray:
    """Solve SBML eq. 16 for a diagonal Gaussian prior, at any number of particles.

    Args:
        w: observation matrix (m, n), dense or sparse, in the unit of z over that of the stiffness.
        z: readings (m,).
        noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
        prior_mean: of the stiffnesses (n,) or one number; may be negative, the estimate is not.
        prior_var: of the stiffnesses, > 0 (n,) or one number.

    Returns:
        The stiffness of every particle, >= 0 (n,) [N/m] (the unit of z over that of W).

    Raises:
        VsfError: shapes that do not fit, values that are not finite, a variance or noise that is not positive.
    """
    w, z, noise, mean, var = _checked(w, z, noise_std, prior_mean, prior_var)
    scale = np.sqrt(var)
    touched = np.flatnonzero(np.diff(w.tocsc().indptr))
    read = np.flatnonzero(np.diff(w.indptr))
    out = np.maximum(mean, 0.0)
    if len(touched) == 0:
        return out
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read][:, touched]
                          @ sparse.diags_array(scale[touched]))
    b, x0 = z[read] / noise[read], mean[touched] / scale[touched]
    out[touched] = scale[touched] * principal_pivoting(a, b, x0, scale=scale[touched])
    return out


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
