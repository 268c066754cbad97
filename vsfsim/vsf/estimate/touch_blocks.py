"""Independent groups of touches in SBML's eq. 15: the covariance of their readings, as dense matrices or by fronts.

`vsfsim.vsf.estimate.evidence` says what is computed; here is how a group's C is factored and used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse

from vsfsim.vsf.estimate.fronts import Factor, Fronts

_TINY = 1e-10
"""Prior variances below this fraction of the largest, where (1 - P^-1_jj) / d_j is a quotient of rounding errors."""
_FEW = 128
"""Particles of a block up to which a dense matrix is factored in any case."""
_FILLED = 0.4
"""Share of a dense factor's work up to which fronts are taken."""
_CHUNK = 1024
"""Particles whose columns are processed at one time: allocating a copy of all would cost more than the arithmetic."""


@dataclass(frozen=True)
class Block:
    """Touches that share particles, reduced by an orthogonal matrix."""

    particle: torch.Tensor
    """HE components that they move (k,)."""
    rows: torch.Tensor
    """Reduced rows of W (r, k)."""
    value: torch.Tensor
    """Reduced readings (r,)."""
    shared: torch.Tensor
    """Reduced rows of W G (r, s)."""
    gram: torch.Tensor | None
    """rows^T rows (k, k) where the particles' side costs less, else None."""

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        return self.rows.numel()

    def predicted(self, stiffness: torch.Tensor) -> torch.Tensor:
        """Readings (r,) of stiffnesses (k,)."""
        return self.rows @ stiffness

    def gathered(self, readings: torch.Tensor) -> torch.Tensor:
        """rows^T readings: (k,) or (k, c) for (r,) or (r, c)."""
        return self.rows.T @ readings

    def solved(self, var: torch.Tensor, right: torch.Tensor) -> Solved:
        """C^-1 of this block on ``right`` (r, c), for the variances ``var`` (k,) of its particles."""
        if self.gram is None:
            spread = torch.eye(len(self.rows), dtype=var.dtype, device=var.device)
            root, buffer = var.sqrt(), self.rows.new_empty((len(self.rows), min(_CHUNK, self.rows.shape[1])))
            for start in range(0, self.rows.shape[1], _CHUNK):
                part = slice(start, start + _CHUNK)
                scaled = torch.mul(self.rows[:, part], root[part], out=buffer[:, :len(root[part])])
                spread.addmm_(scaled, scaled.T)
            factor = torch.linalg.cholesky(spread)
            white = torch.linalg.solve_triangular(factor, right, upper=False)
            return Solved(2.0 * factor.diagonal().log().sum(),
                           torch.linalg.solve_triangular(factor.T, white, upper=True), (white * white).sum(dim=0),
                           factor)
        s = var.sqrt()
        precision = self.gram * s
        precision *= s[:, None]
        precision.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(precision)
        y = torch.cholesky_solve(s[:, None] * (self.rows.T @ right), factor)
        left = right - self.rows @ (s[:, None] * y)
        # |e - A x|^2 + |x / sqrt(d)|^2 equals e^T C^-1 e and is not a difference of two large numbers.
        return Solved(2.0 * factor.diagonal().log().sum(), left, (left * left).sum(dim=0) + (y * y).sum(dim=0), factor)

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """a_j^T C^-1 a_j of every particle (k,)."""
        if self.gram is None:
            out = torch.empty_like(var)
            for start in range(0, self.rows.shape[1], _CHUNK):
                part = slice(start, start + _CHUNK)
                white = torch.linalg.solve_triangular(found.factor, self.rows[:, part], upper=False)
                out[part] = (white * white).sum(dim=0)
            return out
        out = (1.0 - _inverse_diagonal(found.factor)) / var.clamp_min(1e-300)
        few = torch.nonzero(var <= _TINY * var.max())[:, 0]
        if len(few):
            cross = var.sqrt()[:, None] * self.gram[:, few]
            white = torch.linalg.solve_triangular(found.factor, cross, upper=False)
            out[few] = self.gram.diagonal()[few] - (white * white).sum(dim=0)
        return out


@dataclass(frozen=True)
class SparseBlock:
    """Touches that share particles, each of which moves few of them. Their readings are not reduced."""

    particle: torch.Tensor
    """HE components that they move (k,)."""
    rows: sparse.csr_matrix
    """Rows of W (m, k)."""
    columns: sparse.csr_matrix
    """Its transpose (k, m)."""
    value: torch.Tensor
    """Readings (m,)."""
    shared: torch.Tensor
    """Rows of W G (m, s)."""
    fronts: Fronts
    """Order in which rows^T rows is factored."""
    gram: np.ndarray
    """Its entries in the order of ``fronts`` (q,)."""

    @classmethod
    def of(cls, particle: np.ndarray, rows: sparse.csr_matrix, value: np.ndarray,
           shared: np.ndarray) -> SparseBlock | None:
        """The block, or None if dense matrices cost less."""
        m, k = rows.shape
        if not _FEW < k <= m:
            return None
        columns = sparse.csr_matrix(rows.T)
        gram = sparse.csr_matrix(columns @ rows)
        fronts = Fronts.of(gram)
        if fronts.work > _FILLED * k**3 / 6:
            return None
        return cls(torch.as_tensor(particle), rows, columns, torch.as_tensor(value), torch.as_tensor(shared), fronts,
                   np.asarray(gram[fronts.row, fronts.column]).ravel())

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        return max((len(front.own) + len(front.border))**2 for front in self.fronts.fronts)

    def predicted(self, stiffness: torch.Tensor) -> torch.Tensor:
        """As of `Block`."""
        return torch.as_tensor(self.rows @ stiffness.numpy())

    def gathered(self, readings: torch.Tensor) -> torch.Tensor:
        """As of `Block`."""
        given = readings.numpy()
        return torch.as_tensor(_times(self.columns, given) if given.ndim > 1 else self.columns @ given)

    def solved(self, var: torch.Tensor, right: torch.Tensor) -> Solved:
        """As of `Block`."""
        s, given = var.sqrt().numpy(), right.numpy()
        factor = self.fronts.factor(self.gram * s[self.fronts.row] * s[self.fronts.column])
        y = factor.solve(s[:, None] * _times(self.columns, given))
        left = given - _times(self.rows, s[:, None] * y)
        size = np.einsum("ij,ij->j", left, left) + np.einsum("ij,ij->j", y, y)
        return Solved(torch.tensor(factor.log_det, dtype=var.dtype), torch.as_tensor(left), torch.as_tensor(size),
                       factor)

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """As of `Block`."""
        assert isinstance(found.factor, Factor)
        given = var.numpy()
        out = (1.0 - found.factor.inverse_diagonal()) / np.maximum(given, 1e-300)
        few = np.flatnonzero(given <= _TINY * given.max())
        if len(few):
            columns = self.rows[:, few].toarray()
            cross = np.sqrt(given)[:, None] * (self.columns @ columns)
            out[few] = np.einsum("ij,ij->j", columns, columns) - np.einsum("ij,ij->j", cross,
                                                                          found.factor.solve(cross))
        return torch.as_tensor(out)


@dataclass(frozen=True)
class Solved:
    """Solutions with the covariance C of a block."""

    log_det: torch.Tensor
    """log det C."""
    inverse: torch.Tensor
    """C^-1 right (r, c)."""
    quadratic: torch.Tensor
    """right_j^T C^-1 right_j (c,)."""
    factor: torch.Tensor | Factor
    """Lower Cholesky factor of C, or of P where the block has a `gram`."""


def particle_side(rows: int, particles: int) -> bool:
    """Whether a k x k factor and its inverse (k^3 operations) cost less than an r x r one and its product with the rows
    (3 r^2 k and r^3 / 3)."""
    return particles**3 < 3 * rows**2 * particles + rows**3 // 3


def _times(matrix: sparse.csr_matrix, right: np.ndarray) -> np.ndarray:
    """matrix @ right (n, c) column by column, which is faster for a few columns."""
    return np.stack([matrix @ np.ascontiguousarray(column) for column in right.T], axis=1) if right.shape[1] else (
        np.zeros((matrix.shape[0], 0)))


def _inverse_diagonal(factor: torch.Tensor) -> torch.Tensor:
    """Diagonal of (L L^T)^-1 (k,): on a CPU the squared norms of the columns of L^-1, half the work of the inverse."""
    if factor.device.type != "cpu":
        return torch.cholesky_inverse(factor).diagonal()
    upper = factor.numpy().T  # in Fortran's order without a copy
    (invert,) = linalg.get_lapack_funcs(("trtri",), (upper,))
    inverse = invert(upper, lower=0)[0]
    return torch.as_tensor(np.einsum("ij,ij->i", inverse, inverse))
