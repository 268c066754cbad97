"""Online estimation under a composition structure: SBML eq. 16 with K >= 0, and the posterior's spread.

    minimise  1/2 |(z - W theta) / s|^2 + 1/2 |theta - B mu|^2_(B D B^T)^-1   subject to  theta >= 0

With theta = phi + G g the prior's term is 1/2 |theta - mean - G g|^2 / var + 1/2 |g - group_mean|^2 / group_var,
minimised over the few shared components g. For a fixed g this is the program of `map.map_estimate`. Its minimum is a
convex, once differentiable function of g, minimised by Newton's method with a line search. The Hessian needs a matrix
of the size of the smaller side, of readings x readings here:

    H = 1/group_var + (W_F G_F)^T (S + W_F diag(var_F) W_F^T)^-1 (W_F G_F) + G_A^T diag(1/var_A) G_A

F are the particles with theta > 0, A the particles held at 0.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.meta.composition import GaussianPrior

_NEWTON_STEPS = 60
_DECREMENT = 1e-10
"""Newton decrement at which to stop; the objective is a negative log-posterior, whose differences below 1 mean
little."""
_BLOCK = 1024
"""Particles or readings whose standard deviations are computed at one time."""


def structured_map(w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
                   prior: GaussianPrior) -> np.ndarray:
    """Solve SBML eq. 16 for any composition structure.

    Args:
        w: observation matrix (m, n).
        z: readings (m,).
        noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
        prior: on the n stiffnesses.

    Returns:
        theta >= 0 (n,) [N/m].

    Raises:
        VsfError: shapes that do not fit, values that are not finite, a variance that is not positive.
    """
    g = prior.membership
    w = sparse.csr_matrix(w)
    if g.shape[1] == 0:
        return map_estimate(w, z, noise_std=noise_std, prior_mean=prior.mean, prior_var=prior.var)
    if not ((prior.group_var > 0.0).all() and np.isfinite(prior.group_mean).all()):
        raise VsfError("vsf.structured_map: the shared components need finite means and variances greater than 0.")
    z = np.asarray(z, np.float64)
    noise = np.broadcast_to(np.asarray(noise_std, np.float64), (w.shape[0],))
    shared = prior.group_mean.astype(np.float64)
    value, theta = _inner(w, z, noise, prior, shared)
    for _ in range(_NEWTON_STEPS):
        gradient = (shared - prior.group_mean) / prior.group_var - g.T @ ((theta - prior.mean - g @ shared) / prior.var)
        factor = linalg.cho_factor(_hessian(w, noise, prior, theta))
        direction = -linalg.cho_solve(factor, gradient)
        decrement = float(-0.5 * gradient @ direction)
        if decrement <= _DECREMENT * max(1.0, abs(value)):
            return theta
        length = 1.0
        for _ in range(40):
            trial, moved = _inner(w, z, noise, prior, shared + length * direction)
            if trial <= value - 0.5 * length * decrement:
                break
            length *= 0.5
        else:
            return theta  # the remaining descent is below rounding
        shared, value, theta = shared + length * direction, trial, moved
    return theta


def reading_std(w: sparse.csr_matrix, query: sparse.csr_matrix, *, noise_std: np.ndarray | float,
                prior: GaussianPrior) -> np.ndarray:
    """Standard deviation of Q theta, without the readings' own noise and without K >= 0 (q,).

    With A = W / noise and P = diag(var) + G diag(group_var) G^T the posterior's covariance is
    P - P A^T (A P A^T + 1)^-1 A P, on no more rows of A than it moves particles.

    Args:
        w: observation matrix of the readings made (m, n).
        query: observation matrix of the readings to predict, Q (q, n).
        noise_std: standard deviation of the readings of ``w``, > 0 (m,) or one number.
        prior: on theta.
    """
    query = sparse.csr_matrix(query)
    query_shared = (query @ prior.membership).toarray()
    before = query.multiply(query) @ prior.var + query_shared**2 @ prior.group_var
    a = _compressed(sparse.csr_matrix(w), noise_std)
    shared = (a @ prior.membership).toarray()
    weighted = a @ sparse.diags_array(prior.var)
    spread = (weighted @ a.T).toarray() + (shared * prior.group_var) @ shared.T
    spread[np.diag_indices_from(spread)] += 1.0
    factor = linalg.cholesky(spread, lower=True, overwrite_a=True)
    known = np.empty_like(before)
    for start in range(0, len(known), _BLOCK):
        part = slice(start, start + _BLOCK)
        cross = (weighted @ query[part].T).toarray() + (shared * prior.group_var) @ query_shared[part].T
        white = linalg.solve_triangular(factor, cross, lower=True, overwrite_b=True)
        known[part] = np.einsum("ij,ij->j", white, white)
    # A standard deviation below 1e-7 of its prior's is the rounding error of the difference.
    return np.sqrt(np.maximum(before - known, 1e-14 * before))


def _compressed(w: sparse.csr_matrix, noise_std: np.ndarray | float) -> sparse.csr_matrix:
    """Rows A (r, n) in units of the noise, r at most the number of particles that ``w`` (m, n) moves, with the A^T A
    of W / noise: a Cholesky factor of it with pivots, where W has more rows."""
    noise = np.broadcast_to(np.asarray(noise_std, np.float64), (w.shape[0],))
    read = np.flatnonzero(np.diff(w.indptr))
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read])
    moved = np.unique(a.indices)
    if len(read) <= len(moved):
        return a
    part = a[:, moved]
    factor, order, rank, _ = linalg.lapack.dpstrf((part.T @ part).toarray(), lower=0, overwrite_a=1)
    rows = np.triu(factor)[:rank]
    return sparse.csr_matrix((rows.ravel(), np.tile(moved[order - 1], rank), np.arange(rank + 1) * len(moved)),
                             shape=(rank, w.shape[1]))


def _inner(w: sparse.csr_matrix, z: np.ndarray, noise: np.ndarray, prior: GaussianPrior,
           shared: np.ndarray) -> tuple[float, np.ndarray]:
    """Value and stiffnesses of the program at fixed shared components."""
    centre = prior.mean + prior.membership @ shared
    theta = map_estimate(w, z, noise_std=noise, prior_mean=centre, prior_var=prior.var)
    misfit = (z - w @ theta) / noise
    value = 0.5 * (misfit @ misfit + np.sum((theta - centre) ** 2 / prior.var)
                   + np.sum((shared - prior.group_mean) ** 2 / prior.group_var))
    return float(value), theta


def _hessian(w: sparse.csr_matrix, noise: np.ndarray, prior: GaussianPrior, theta: np.ndarray) -> np.ndarray:
    g = prior.membership
    free = theta > 0.0
    out = np.diag(1.0 / prior.group_var)
    held = g[~free]
    out += (held.T @ sparse.diags_array(1.0 / prior.var[~free]) @ held).toarray()
    a = _compressed(sparse.csr_matrix(w[:, free]), noise)
    ag = (a @ g[free]).toarray()
    spread = (a @ sparse.diags_array(prior.var[free]) @ a.T).toarray()
    spread[np.diag_indices_from(spread)] += 1.0
    return out + ag.T @ linalg.solve(spread, ag, assume_a="pos") if len(ag) else out
