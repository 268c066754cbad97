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

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.map import map_estimate, posterior_std
from vsfsim.vsf.meta.composition import GaussianPrior

_NEWTON_STEPS = 60
_DECREMENT = 1e-10
"""Newton decrement at which to stop; the objective is a negative log-posterior, whose differences below 1 mean
little."""
_BLOCK = 1024
"""Particles or readings whose standard deviations are computed at one time."""


@dataclass(frozen=True)
class StructuredResult:
    """The most probable stiffnesses."""

    mean: np.ndarray
    """theta >= 0 (n,) [N/m]."""
    shared: np.ndarray
    """The shared components g (s,) [N/m]."""
    steps: int
    """Newton steps on g."""
    decrement: float
    """Newton decrement of the last step: an estimate of how far the negative log-posterior is above its minimum [-]."""


def structured_map(w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
                   prior: GaussianPrior) -> StructuredResult:
    """Solve SBML eq. 16 for any composition structure.

    Args:
        w: observation matrix (m, n).
        z: readings (m,).
        noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
        prior: on the n stiffnesses.

    Raises:
        VsfError: shapes that do not fit, values that are not finite, a variance that is not positive.
    """
    g = prior.membership
    w = sparse.csr_matrix(w)
    if g.shape[1] == 0:
        return StructuredResult(map_estimate(w, z, noise_std=noise_std, prior_mean=prior.mean,
                                             prior_var=prior.var).mean, np.zeros(0), 0, 0.0)
    if not ((prior.group_var > 0.0).all() and np.isfinite(prior.group_mean).all()):
        raise VsfError("vsf.structured_map: the shared components need finite means and variances greater than 0.")
    z = np.asarray(z, np.float64)
    noise = np.broadcast_to(np.asarray(noise_std, np.float64), (w.shape[0],))
    shared = prior.group_mean.astype(np.float64)
    value, theta = _inner(w, z, noise, prior, shared)
    decrement = np.inf
    for step in range(_NEWTON_STEPS):
        gradient = (shared - prior.group_mean) / prior.group_var - g.T @ ((theta - prior.mean - g @ shared) / prior.var)
        factor = linalg.cho_factor(_hessian(w, noise, prior, theta))
        direction = -linalg.cho_solve(factor, gradient)
        decrement = float(-0.5 * gradient @ direction)
        if decrement <= _DECREMENT * max(1.0, abs(value)):
            return StructuredResult(theta, shared, step, decrement)
        length = 1.0
        for _ in range(40):
            trial, moved = _inner(w, z, noise, prior, shared + length * direction)
            if trial <= value - 0.5 * length * decrement:
                break
            length *= 0.5
        else:
            # The remaining descent is below rounding.
            return StructuredResult(theta, shared, step, decrement)
        shared, value, theta = shared + length * direction, trial, moved
    return StructuredResult(theta, shared, _NEWTON_STEPS, decrement)


def structured_std(w: sparse.csr_matrix, *, noise_std: np.ndarray | float, prior: GaussianPrior) -> np.ndarray:
    """Standard deviation of each stiffness under the Gaussian posterior, without K >= 0 (n,) [N/m]. Where all variances
    of the heterogeneous components are 0, only the shared ones vary.

    Computed on the smaller side, of readings or of touched particles.

    Args, Raises: as `structured_map`.
    """
    g = prior.membership
    w = sparse.csr_matrix(w)
    if g.shape[1] == 0:
        return posterior_std(w, noise_std=noise_std, prior_var=prior.var)
    if not prior.var.any():
        return _shared_std(w, g, noise_std, prior)
    return _spread(w, sparse.identity(w.shape[1], format="csr"), noise_std, prior)


def reading_std(w: sparse.csr_matrix, query: sparse.csr_matrix, *, noise_std: np.ndarray | float,
                prior: GaussianPrior) -> np.ndarray:
    """Standard deviation of Q theta, without the readings' own noise and without K >= 0 (q,).

    Args:
        w: observation matrix of the readings made (m, n).
        query: observation matrix of the readings to predict, Q (q, n).
        noise_std: standard deviation of the readings of ``w``, > 0 (m,) or one number.
        prior: on theta.
    """
    query = sparse.csr_matrix(query)
    if not prior.var.any():
        return _shared_std(sparse.csr_matrix(w), query @ prior.membership, noise_std, prior)
    return _spread(sparse.csr_matrix(w), query, noise_std, prior)


def _spread(w: sparse.csr_matrix, query: sparse.csr_matrix, noise_std: np.ndarray | float,
            prior: GaussianPrior) -> np.ndarray:
    """Standard deviations of Q theta (q,), where the heterogeneous components vary."""
    out = query.multiply(query) @ prior.var + (query @ prior.membership).toarray() ** 2 @ prior.group_var
    before = out.copy()
    read = np.flatnonzero(np.diff(w.indptr))
    if len(read):
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), (w.shape[0],))
        a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read])
        touched = np.flatnonzero(np.diff(a.tocsc().indptr))
        side = _Particles.of(a, touched, prior) if len(touched) < a.shape[0] else _Readings.of(a, prior)
        for start in range(0, len(out), _BLOCK):
            part = slice(start, start + _BLOCK)
            out[part] = side.left(query[part], before[part], prior)
    # A standard deviation below 1e-7 of its prior's is the rounding error of the difference.
    return np.sqrt(np.maximum(out, 1e-14 * before))


def _shared_std(w: sparse.csr_matrix, members: sparse.csr_matrix, noise_std: np.ndarray | float,
                prior: GaussianPrior) -> np.ndarray:
    """Standard deviations of ``members`` (q, s) times the shared components (q,), where nothing else varies."""
    noise = np.broadcast_to(np.asarray(noise_std, np.float64), (w.shape[0],))
    a = (w @ sparse.csr_matrix(prior.membership)).toarray() / noise[:, None]
    factor = linalg.cholesky(np.diag(1.0 / prior.group_var) + a.T @ a, lower=True)
    return np.linalg.norm(linalg.solve_triangular(factor, members.toarray().T, lower=True), axis=0)


@dataclass(frozen=True)
class _Readings:
    """The posterior on the side of the readings: P - P A^T (A P A^T + 1)^-1 A P, with A = W / noise and
    P = diag(var) + G diag(group_var) G^T."""

    a: sparse.csr_matrix
    """A (r, n)."""
    shared: np.ndarray
    """A G (r, s)."""
    factor: np.ndarray
    """Lower Cholesky factor of A P A^T + 1 (r, r)."""

    @classmethod
    def of(cls, a: sparse.csr_matrix, prior: GaussianPrior) -> _Readings:
        shared = (a @ prior.membership).toarray()
        spread = (a @ sparse.diags_array(prior.var) @ a.T).toarray() + (shared * prior.group_var) @ shared.T
        spread[np.diag_indices_from(spread)] += 1.0
        return cls(a, shared, linalg.cholesky(spread, lower=True))

    def left(self, query: sparse.csr_matrix, before: np.ndarray, prior: GaussianPrior) -> np.ndarray:
        """Variances of Q theta (q,), which the prior gives as ``before``."""
        cross = (self.a @ sparse.diags_array(prior.var) @ query.T).toarray()
        cross += (self.shared * prior.group_var) @ (query @ prior.membership).toarray().T
        white = linalg.solve_triangular(self.factor, cross, lower=True)
        return before - np.einsum("ij,ij->j", white, white)


@dataclass(frozen=True)
class _Particles:
    """The posterior on the side of the touched particles, as a sum of two variances.

    With R = diag(sqrt(var)) and P = 1 + R A^T A R the heterogeneous components have the covariance R P^-1 R for known
    shared ones. These have the precision 1 / group_var + G^T Z, with

        Z = A^T (A R^2 A^T + 1)^-1 A G = R^-1 P^-1 R A^T A G

    and Q theta moves with them by H = Q G - Q R^2 Z.
    """

    touched: np.ndarray
    """Particles that some reading moves (k,) int."""
    factor: np.ndarray
    """Lower Cholesky factor of P (k, k)."""
    pull: np.ndarray
    """Z (k, s)."""
    group: np.ndarray
    """Lower Cholesky factor of 1 + diag(sqrt(group_var)) G^T Z diag(sqrt(group_var)) (s, s)."""

    @classmethod
    def of(cls, a: sparse.csr_matrix, touched: np.ndarray, prior: GaussianPrior) -> _Particles:
        members = sparse.csr_matrix(prior.membership)[touched]
        factor, pull = _pull(a[:, touched], members, prior.var[touched])
        group_root = np.sqrt(prior.group_var)
        inside = group_root[:, None] * (members.T @ pull) * group_root
        return cls(touched, factor, pull, linalg.cholesky(np.eye(len(inside)) + 0.5 * (inside + inside.T), lower=True))

    def left(self, query: sparse.csr_matrix, before: np.ndarray, prior: GaussianPrior) -> np.ndarray:
        """Variances of Q theta (q,); ``before`` is not needed."""
        var = prior.var.copy()
        var[self.touched] = 0.0
        out = query.multiply(query) @ var
        mine = query[:, self.touched]
        some = np.flatnonzero(np.diff(mine.indptr))  # the others meet no touched particle
        scaled = mine[some].toarray().T * np.sqrt(prior.var[self.touched])[:, None]
        white = linalg.solve_triangular(self.factor, scaled, lower=True)
        out[some] += np.einsum("ij,ij->j", white, white)
        moves = (query @ prior.membership).toarray() - mine @ (prior.var[self.touched][:, None] * self.pull)
        shared = linalg.solve_triangular(self.group, (moves * np.sqrt(prior.group_var)).T, lower=True)
        return out + np.einsum("ij,ij->j", shared, shared)


def _pull(a: sparse.csr_matrix, members: sparse.csr_matrix, var: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """P's lower Cholesky factor and Z of `_Particles`, for A (r, k), G (k, s) and the variances (k,) of k particles."""
    root = np.maximum(np.sqrt(var), 1e-100)  # R^-1 stays finite
    gram = (a.T @ a).toarray()
    precision = gram * root * root[:, None]
    precision[np.diag_indices_from(precision)] += 1.0
    factor = linalg.cholesky(precision, lower=True, overwrite_a=True)
    return factor, linalg.cho_solve((factor, True), root[:, None] * (gram @ members.toarray())) / root[:, None]


def _inner(w: sparse.csr_matrix, z: np.ndarray, noise: np.ndarray, prior: GaussianPrior,
           shared: np.ndarray) -> tuple[float, np.ndarray]:
    """Value and stiffnesses of the program at fixed shared components."""
    centre = prior.mean + prior.membership @ shared
    theta = map_estimate(w, z, noise_std=noise, prior_mean=centre, prior_var=prior.var).mean
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
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise) @ w)[:, free]
    a = a[np.flatnonzero(np.diff(a.indptr))]
    if a.shape[0] == 0:
        return out
    moved = np.flatnonzero(np.diff(a.tocsc().indptr))
    a, members, var = a[:, moved], g[free][moved], prior.var[free][moved]
    if len(moved) < a.shape[0]:
        return out + members.T @ _pull(a, members, var)[1]
    ag = (a @ members).toarray()
    spread = (a @ sparse.diags_array(var) @ a.T).toarray()
    spread[np.diag_indices_from(spread)] += 1.0
    return out + ag.T @ linalg.cho_solve(linalg.cho_factor(spread), ag)
