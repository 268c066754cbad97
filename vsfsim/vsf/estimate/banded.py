"""Inverse of a sparse positive definite matrix where it is needed: on the pattern of the matrix itself, by blocks along
its band.

Readings on the vertices of a sensor are coupled only where both hold the same particle, that is, between neighbours of
its mesh. In the order of reverse Cuthill and McKee (1969) the matrix M of such readings is block tridiagonal, with D_i
on the diagonal and E_i below it, and

    S_0 = D_0,   X_i = S_i^-1 E_i^T,   S_i+1 = D_i+1 - E_i X_i
    Z_nn = S_n^-1,   Z_i,i+1 = -X_i Z_i+1,i+1,   Z_ii = S_i^-1 - Z_i,i+1 X_i^T

gives the blocks Z of M^-1 in the same places (Takahashi, Fagan and Chen 1973) and no others.
"""

from __future__ import annotations

import itertools

import numpy as np
from scipy import linalg, sparse
from scipy.sparse import csgraph


class Band:
    """An order of ``size`` readings in which coupled readings are close; `learn` adds couplings to it."""

    position: np.ndarray
    """Place of each reading in the order (size,) int."""
    width: int
    """Largest distance of coupled readings in the order."""

    def __init__(self, size: int):
        self.position, self.width = np.arange(size), 0
        self._couplings = sparse.csr_matrix((size, size), dtype=np.int8)
        self._inverse = np.zeros((0, 0))

    def holds(self, reading: np.ndarray, matrix: sparse.csr_matrix) -> bool:
        """Whether all couplings of ``matrix`` (r, r) between the readings ``reading`` (r,) are within the width."""
        if matrix.nnz == 0:
            return True
        place = self.position[reading]
        return bool(np.abs(np.repeat(place, np.diff(matrix.indptr)) - place[matrix.indices]).max() <= self.width)

    def learn(self, reading: np.ndarray, matrix: sparse.csr_matrix) -> None:
        """Add the couplings of ``matrix`` (r, r) between the readings ``reading`` (r,), and compute the order again."""
        size = len(self.position)
        row = reading[np.repeat(np.arange(len(reading)), np.diff(matrix.indptr))]
        more = sparse.csr_matrix((np.ones(matrix.nnz, np.int8), (row, reading[matrix.indices])), shape=(size, size))
        self._couplings = sparse.csr_matrix(self._couplings.maximum(more))
        order = csgraph.reverse_cuthill_mckee(self._couplings, symmetric_mode=True)
        self.position[order] = np.arange(size)
        row = np.repeat(np.arange(size), np.diff(self._couplings.indptr))
        self.width = int(np.abs(self.position[row] - self.position[self._couplings.indices]).max())

    def solve(self, matrix: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M^-1 on the band and M^-1 right.

        Args:
            matrix: M (r, r), its readings in the order of `position`; overwritten.
            right: (r,).

        Returns:
            An array (>= r, >= r) that holds M^-1 where two readings are within the width, and is undefined elsewhere;
            the next call uses it again. Then M^-1 right (r,).

        Raises:
            LinAlgError: M is not positive definite.
        """
        r = len(matrix)
        step = max(self.width, 1)
        cuts = [*range(0, r, step), r]
        # A last block of a few rows is joined to the one before: its calls would cost more than its arithmetic.
        if len(cuts) > 2 and cuts[-1] - cuts[-2] < step // 3:
            del cuts[-2]
        parts = [slice(a, b) for a, b in itertools.pairwise(cuts)]
        if len(self._inverse) < r:
            self._inverse = np.zeros((r, r))
        z, inverses, across, rest = self._inverse, [], [], right.copy()
        for i, part in enumerate(parts):
            inverse = _inverse(matrix[part, part])
            inverses.append(inverse)
            if i + 1 < len(parts):
                after = parts[i + 1]
                below = matrix[after, part]
                x = inverse @ below.T
                across.append(x)
                matrix[after, after] -= below @ x
                rest[after] -= x.T @ rest[part]
        solution = np.empty(r)
        for i in range(len(parts) - 1, -1, -1):
            part = parts[i]
            solution[part] = inverses[i] @ rest[part]
            if i + 1 == len(parts):
                z[part, part] = inverses[i]
                continue
            after, x = parts[i + 1], across[i]
            solution[part] -= x @ solution[after]
            off = -(x @ z[after, after])
            z[part, after] = off
            z[after, part] = off.T
            z[part, part] = inverses[i] - off @ x.T
        return z, solution


def _inverse(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a positive definite matrix, by LAPACK's potrf and potri.

    Raises:
        LinAlgError: rounding errors made it indefinite.
    """
    factor, failed = linalg.lapack.dpotrf(matrix, lower=1)
    if failed:
        raise linalg.LinAlgError("the readings' covariance is not positive definite: noise_std is too small beside "
                                 "what the prior explains")
    half = linalg.lapack.dpotri(factor, lower=1, overwrite_c=1)[0]
    # Above the diagonal potrf and potri leave zeros.
    out = half + half.T
    out[np.diag_indices_from(out)] *= 0.5
    return out
