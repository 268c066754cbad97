"""Online estimation of a VSF: the diagonal Kalman filter (Neural VSF sections III-B and III-C).

The stiffnesses are independent Gaussians. A frame of readings z = W K + noise updates them exactly; the correlations
that this introduces are then dropped:

    M = W V W^T + S,   K += V W^T M^-1 (z - W K),   v_i -= v_i^2 w_i^T M^-1 w_i,   K = max(K, 0)

A replay of an earlier frame repeats the update of K alone, with the variances as they are: the reading was counted
before, but K no longer fits it once later frames have moved the same particles.

w_i is column i of W. Only the particles that a frame moves change. M is factorised once, or, with fewer particles than
readings, the particles' precision matrix V^-1 + W^T S^-1 W is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy import linalg, sparse

from vsfsim.core.errors import VsfError


@dataclass
class DiagonalFilter:
    """Stiffnesses as independent Gaussians, updated frame by frame."""

    mean: np.ndarray
    """Means, >= 0 after every update (n,) [N/m]."""
    var: np.ndarray
    """Variances, > 0 (n,) [(N/m)^2]."""
    _frames: list[tuple[sparse.csr_matrix, np.ndarray, np.ndarray]] = field(default_factory=list, repr=False)
    """Frames that may be replayed: rows, readings and their noise."""

    @classmethod
    def start(cls, particles: int, *, mean: np.ndarray | float, var: np.ndarray | float) -> DiagonalFilter:
        """The filter before any reading.

        Args:
            particles: their number, n.
            mean: of the prior (n,) or one number [N/m].
            var: of the prior, > 0 (n,) or one number [(N/m)^2].

        Raises:
            VsfError: values that are not finite, or a variance that is not positive.
        """
        try:
            first, spread = (np.array(np.broadcast_to(np.asarray(x, np.float64), (particles,))) for x in (mean, var))
        except ValueError:
            raise VsfError(f"vsf.kalman: the prior has shapes {np.shape(mean)} and {np.shape(var)} for {particles} "
                           f"particles; give one number or ({particles},).") from None
        out = cls(first, spread)
        if not (np.isfinite(out.mean).all() and np.isfinite(out.var).all() and (out.var > 0.0).all()):
            raise VsfError("vsf.kalman: the prior's mean must be finite and its variance finite and greater than 0.")
        return out

    def update(self, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
               replayed: bool = False) -> None:
        """Update by the readings of one frame.

        Args:
            w: observation matrix (m, n).
            z: readings (m,).
            noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
            replayed: the frame was assimilated before; the variances stay as they are.

        Raises:
            VsfError: shapes that do not fit, a reading that is not finite, a noise that is not positive.
        """
        w = sparse.csr_matrix(w)
        z = np.asarray(z, np.float64)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), z.shape)
        if w.shape != (len(z), len(self.mean)):
            raise VsfError(f"vsf.kalman: W is {w.shape[0]} x {w.shape[1]} for {len(z)} readings and "
                           f"{len(self.mean)} particles.")
        if not (np.isfinite(z).all() and np.isfinite(w.data).all() and (noise > 0.0).all()):
            raise VsfError("vsf.kalman: a frame has readings or rows that are not finite, or a noise that is not "
                           "positive; leave the frame out.")
        if w.nnz == 0:
            return
        read = np.flatnonzero(np.diff(w.indptr))
        moved = np.unique(w.indices)
        a = sparse.csr_matrix(sparse.diags_array(1.0 / noise[read]) @ w[read][:, moved])
        surprise = z[read] / noise[read] - a @ self.mean[moved]
        var = self.var[moved]
        shift, left = _updated(a, surprise, var)
        self.mean[moved] = np.maximum(self.mean[moved] + shift, 0.0)
        if not replayed:
            # A variance that falls by fourteen orders of magnitude may be negative by rounding.
            self.var[moved] = np.maximum(left, 1e-14 * var)

    def run(self, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float, size: int = 1,
            replay: int = 0, seed: int = 0) -> None:
        """`update` frame by frame: frame t has rows ``size`` t to ``size`` (t + 1) of ``w`` (T size, n) and ``z`` (T
        size,).

        Args:
            w, z, noise_std: as of `update`, of all frames.
            size: readings of a frame.
            replay: frames that are drawn with replacement from those assimilated by any call of `run`, the newest
                among them, and replayed after each new one.
            seed: of that draw, >= 0.
        """
        w = sparse.csr_matrix(w)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), np.shape(z))
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(len(self._frames),)))
        for start in range(0, w.shape[0], size):
            if w.indptr[start] < w.indptr[min(start + size, w.shape[0])]:
                part = slice(start, start + size)
                self.update(w[part], z[part], noise_std=noise[part])
                if replay:
                    self._frames.append((w[part], np.asarray(z, np.float64)[part], noise[part]))
                    for index in rng.integers(len(self._frames), size=replay):
                        rows, values, std = self._frames[index]
                        self.update(rows, values, noise_std=std, replayed=True)


def _updated(a: sparse.csr_matrix, surprise: np.ndarray, var: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shift of the means and new variances for ``a`` (r, k), in units of the noise: through M (r, r), or with fewer
    particles than readings through the precision matrix (k, k)."""
    weighted, few = sparse.csr_matrix(a @ sparse.diags_array(var)), a.shape[1] < a.shape[0]
    matrix = (a.T @ a if few else weighted @ a.T).toarray()
    matrix[np.diag_indices_from(matrix)] += 1.0 / var if few else 1.0
    # LAPACK's potri takes half the work of solving for the identity
    half = linalg.lapack.dpotri(linalg.cholesky(matrix, lower=True, check_finite=False), lower=1)[0]
    inverse = half + np.tril(half, -1).T
    if few:
        return inverse @ (a.T @ surprise), inverse.diagonal().copy()
    columns = sparse.csr_matrix(a.T)
    known = np.asarray(columns.multiply(columns @ inverse).sum(axis=1)).ravel()
    return weighted.T @ (inverse @ surprise), var * (1.0 - var * known)
