"""Online estimation of a VSF: the diagonal Kalman filter (Neural VSF sections III-B and III-C).

The stiffnesses are kept as independent Gaussians. A frame of readings z = W K + noise updates them exactly, and what it correlates
is then forgotten:

    M = W V W^T + S,   K += V W^T M^-1 (z - W K),   v_i -= v_i^2 w_i^T M^-1 w_i,   K = max(K, 0)

w_i is column i of W. Only the particles a frame moves are touched, and M is factorised once; with fewer particles than
readings the same update is made through the particles' precision matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from vsfsim.vsf.dynamics import VsfError


@dataclass
class DiagonalFilter:
    """Stiffnesses as independent Gaussians, updated frame by frame.

    mean: >= 0 after every update (n,) [N/m]. var: > 0 (n,) [(N/m)^2].
    """

    mean: np.ndarray
    var: np.ndarray

    @classmethod
    def start(cls, particles: int, *, mean: np.ndarray | float, var: np.ndarray | float) -> DiagonalFilter:
        """From a prior, one number or one a particle.

        Raises:
            VsfError: values that are not finite, or a variance that is not positive.
        """
        try:
            out = cls(*(np.array(np.broadcast_to(np.asarray(x, np.float64), (particles,))) for x in (mean, var)))
        except ValueError:
            raise VsfError(f"vsf.kalman: the prior has shapes {np.shape(mean)} and {np.shape(var)} for {particles} particles; give one number or ({particles},).") from None
        if not (np.isfinite(out.mean).all() and np.isfinite(out.var).all() and (out.var > 0.0).all()):
            raise VsfError("vsf.kalman: the prior's mean must be finite and its variance finite and greater than 0.")
        return out

    def update(self, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float) -> None:
        """Take in the readings of one frame.

        Args:
            w: observation matrix (m, n). z: readings (m,). noise_std: > 0, (m,) or one number, in the unit of z.

        Raises:
            VsfError: shapes that do not fit, a reading that is not finite, a noise that is not positive.
        """
        w = sparse.csr_matrix(w)
        z = np.asarray(z, np.float64)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), z.shape)
        if w.shape != (len(z), len(self.mean)):
            raise VsfError(f"vsf.kalman: W is {w.shape[0]} x {w.shape[1]} for {len(z)} readings and {len(self.mean)} particles.")
        if not (np.isfinite(z).all() and np.isfinite(w.data).all() and (noise > 0.0).all()):
            raise VsfError("vsf.kalman: a frame has readings or rows that are not finite, or a noise that is not positive; leave the frame out.")
        rows = np.flatnonzero(np.diff(w.indptr))
        if len(rows) == 0:
            return
        moved = np.unique(w.indices)
        place = np.searchsorted(moved, w.indices)
        a = sparse.csr_matrix((w.data, place, w.indptr), shape=(len(z), len(moved)))[rows]
        a.data *= np.repeat(1.0 / noise[rows], np.diff(a.indptr))
        surprise = z[rows] / noise[rows] - a @ self.mean[moved]
        var = self.var[moved]
        shift, left = _by_particles(a, surprise, var) if len(moved) < len(rows) else _by_readings(a, surprise, var)
        self.mean[moved] = np.maximum(self.mean[moved] + shift, 0.0)
        # Rounding may leave a little less than nothing of a variance that fell by fourteen orders.
        self.var[moved] = np.maximum(left, 1e-14 * var)

    def run(self, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float, size: int = 1) -> None:
        """Frame after frame: rows ``size`` t to ``size`` (t + 1) of ``w`` (T size, n) and ``z`` (T size,) are frame t."""
        w = sparse.csr_matrix(w)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), np.shape(z))
        for start in range(0, w.shape[0], size):
            if w.indptr[start] < w.indptr[min(start + size, w.shape[0])]:
                part = slice(start, start + size)
                self.update(w[part], z[part], noise_std=noise[part])


def _by_readings(a: sparse.csr_matrix, surprise: np.ndarray, var: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shift of the means and new variances, through M (readings x readings); noise is 1."""
    weighted = a.copy()
    weighted.data = weighted.data * var[a.indices]
    spread = (weighted @ a.T).toarray()
    spread[np.diag_indices_from(spread)] += 1.0
    factor = linalg.cho_factor(spread, lower=True, overwrite_a=True, check_finite=False)
    shift = weighted.T @ linalg.cho_solve(factor, surprise, check_finite=False)
    if a.nnz * 4 < a.shape[0] * a.shape[1]:
        # Sparse rows: w_i^T M^-1 w_i needs M^-1 at the few pairs of readings that a particle has.
        inverse = _inverse(factor[0])
        fall = _quadratic_forms(a.tocsc(), inverse)
    else:
        white = linalg.solve_triangular(factor[0], a.toarray(), lower=True, check_finite=False)
        fall = np.einsum("ij,ij->j", white, white)
    return shift, var * (1.0 - var * fall)


def _by_particles(a: sparse.csr_matrix, surprise: np.ndarray, var: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same through the precision matrix V^-1 + A^T A (particles x particles)."""
    precision = (a.T @ a).toarray()
    precision[np.diag_indices_from(precision)] += 1.0 / var
    factor = linalg.cho_factor(precision, lower=True, overwrite_a=True, check_finite=False)
    inverse = _inverse(factor[0])
    return inverse @ (a.T @ surprise), np.diag(inverse).copy()


def _inverse(lower: np.ndarray) -> np.ndarray:
    """Of a matrix with this Cholesky factor, by LAPACK's potri: half the work of solving for the identity."""
    half = np.tril(linalg.lapack.dpotri(lower, lower=1)[0])
    return half + np.tril(half, -1).T


def _quadratic_forms(columns: sparse.csc_matrix, matrix: np.ndarray) -> np.ndarray:
    """c_j^T matrix c_j of every column (k,)."""
    count = np.diff(columns.indptr)
    out = np.zeros(len(count))
    for size in np.unique(count[count > 0]):
        which = np.flatnonzero(count == size)
        entry = columns.indptr[which][:, None] + np.arange(size)
        row, value = columns.indices[entry], columns.data[entry]
        out[which] = np.einsum("ka,kab,kb->k", value, matrix[row[:, :, None], row[:, None, :]], value)
    return out
