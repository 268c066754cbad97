"""Independent groups of touches in SBML's eq. 15: the covariance of their readings, as dense matrices or by fronts.

`vsfsim.vsf.estimate.evidence` says what is computed; here is how a group's C is factored and used. All kinds of blocks
answer the same questions: `solved`, `weighed`, `crossed` and `sizes`, where A are the group's rows, U = A G those of
its shared components, and e = z - A mean - U group_mean.

    Block        dense rows, reduced by an orthogonal matrix
    SparseBlock  sparse rows, and a factor by fronts: on a CPU, where touches each move few of the particles
    GramBlock    A^T A alone, dense: on a GPU, which factors a dense matrix in less time than many small ones
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse

from vsfsim.vsf.estimate.fronts import Factor, Fronts

_TINY = 1e-10
"""Prior variances below this fraction of the largest, where (1 - P^-1_jj) / d_j is a quotient of rounding errors."""
FEW = 128
"""Particles of a block up to which a dense matrix is factored in any case."""
_FILLED = 0.4
"""Share of a dense factor's work up to which fronts are taken."""
_RIDGE = 1e-12
"""Part of the largest diagonal entry of A^T A that is added to it, so that it has a factor."""
_CHUNK = 1024
"""Particles whose columns are processed at one time: allocating a copy of all would cost more than the arithmetic."""


class _ByReadings(ABC):
    """What blocks with rows have in common."""

    particle: torch.Tensor
    value: torch.Tensor
    shared: torch.Tensor

    @abstractmethod
    def predicted(self, stiffness: torch.Tensor) -> torch.Tensor:
        """Readings (r,) of stiffnesses (k,)."""

    @abstractmethod
    def gathered(self, readings: torch.Tensor) -> torch.Tensor:
        """rows^T readings: (k,) or (k, c) for (r,) or (r, c)."""

    @abstractmethod
    def inverted(self, var: torch.Tensor, right: torch.Tensor) -> _Inverted:
        """C^-1 on ``right`` (r, c), for the variances ``var`` (k,) of its particles."""

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """What the likelihood needs of C^-1.

        Args:
            mean, var: of its particles (k,).
            group_mean: of the shared components (s,).
        """
        e = self.value - self.predicted(mean) - self.shared @ group_mean
        found = self.inverted(var, torch.cat([e[:, None], self.shared], dim=1))
        return Solved(found.log_det, found.quadratic[0], self.shared.T @ found.inverse[:, 1:],
                      self.shared.T @ found.inverse[:, 0], found.inverse, found.factor)

    def weighed(self, found: Solved, shift: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A^T a (k,) and U^T a (s,) of a = C^-1 (e - U shift)."""
        alpha = found.left[:, 0] - found.left[:, 1:] @ shift
        return self.gathered(alpha), self.shared.T @ alpha

    def crossed(self, found: Solved) -> torch.Tensor:
        """A^T C^-1 U (k, s)."""
        return self.gathered(found.left[:, 1:])


@dataclass(frozen=True)
class Block(_ByReadings):
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
        """As of `_ByReadings`."""
        return self.rows @ stiffness

    def gathered(self, readings: torch.Tensor) -> torch.Tensor:
        """As of `_ByReadings`."""
        return self.rows.T @ readings

    def inverted(self, var: torch.Tensor, right: torch.Tensor) -> _Inverted:
        """As of `_ByReadings`."""
        if self.gram is None:
            spread = torch.eye(len(self.rows), dtype=var.dtype, device=var.device)
            root, buffer = var.sqrt(), self.rows.new_empty((len(self.rows), min(_CHUNK, self.rows.shape[1])))
            for start in range(0, self.rows.shape[1], _CHUNK):
                part = slice(start, start + _CHUNK)
                scaled = torch.mul(self.rows[:, part], root[part], out=buffer[:, :len(root[part])])
                spread.addmm_(scaled, scaled.T)
            factor = torch.linalg.cholesky(spread)
            white = torch.linalg.solve_triangular(factor, right, upper=False)
            return _Inverted(2.0 * factor.diagonal().log().sum(),
                             torch.linalg.solve_triangular(factor.T, white, upper=True), (white * white).sum(dim=0),
                             factor)
        s = var.sqrt()
        factor = _factored(self.gram, s)
        y = torch.cholesky_solve(s[:, None] * (self.rows.T @ right), factor)
        left = right - self.rows @ (s[:, None] * y)
        # |e - A x|^2 + |x / sqrt(d)|^2 equals e^T C^-1 e and is not a difference of two large numbers.
        return _Inverted(2.0 * factor.diagonal().log().sum(), left, (left * left).sum(dim=0) + (y * y).sum(dim=0),
                         factor)

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """a_j^T C^-1 a_j of every particle (k,)."""
        if self.gram is None:
            out = torch.empty_like(var)
            for start in range(0, self.rows.shape[1], _CHUNK):
                part = slice(start, start + _CHUNK)
                white = torch.linalg.solve_triangular(found.factor, self.rows[:, part], upper=False)
                out[part] = (white * white).sum(dim=0)
            return out
        return _sizes(self.gram, var, found)


@dataclass(frozen=True)
class SparseBlock(_ByReadings):
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
        if not FEW < k <= m:
            return None
        columns = sparse.csr_matrix(rows.T)
        gram = sparse.csr_matrix(columns @ rows)
        fronts = Fronts.of(gram)
        if fronts.work > _FILLED * k**3 / 6:
            return None
        return cls(torch.as_tensor(particle), rows, columns, torch.as_tensor(value), torch.as_tensor(shared), fronts,
                   gram.data[fronts.kept])

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        return max((len(front.own) + len(front.border))**2 for front in self.fronts.fronts)

    def predicted(self, stiffness: torch.Tensor) -> torch.Tensor:
        """As of `_ByReadings`."""
        return torch.as_tensor(self.rows @ stiffness.numpy())

    def gathered(self, readings: torch.Tensor) -> torch.Tensor:
        """As of `_ByReadings`."""
        given = readings.numpy()
        return torch.as_tensor(_times(self.columns, given) if given.ndim > 1 else self.columns @ given)

    def inverted(self, var: torch.Tensor, right: torch.Tensor) -> _Inverted:
        """As of `_ByReadings`."""
        s, given = var.sqrt().numpy(), right.numpy()
        factor = self.fronts.factor(self.gram * s[self.fronts.row] * s[self.fronts.column])
        y = factor.solve(s[:, None] * _times(self.columns, given))
        left = given - _times(self.rows, s[:, None] * y)
        size = np.einsum("ij,ij->j", left, left) + np.einsum("ij,ij->j", y, y)
        return _Inverted(torch.tensor(factor.log_det, dtype=var.dtype), torch.as_tensor(left), torch.as_tensor(size),
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
class GramBlock:
    """Touches of which A^T A is kept, and no row: k^2 numbers instead of m k.

    Readings enter by their distance from those of one point ``at`` near the least squares solution. What is written
    out here holds for any point; that it is near keeps large terms from cancelling.
    """

    particle: torch.Tensor
    """HE components that they move (k,)."""
    gram: torch.Tensor
    """G = A^T A (k, k)."""
    at: torch.Tensor
    """The point, in the unit of a stiffness (k,)."""
    rest: torch.Tensor
    """A^T (z - A at) (k,)."""
    size: torch.Tensor
    """|z - A at|^2."""
    joint: torch.Tensor
    """A^T U (k, s)."""
    among: torch.Tensor
    """U^T U (s, s)."""
    met: torch.Tensor
    """U^T (z - A at) (s,)."""

    @classmethod
    def of(cls, particle: np.ndarray, rows: sparse.csr_matrix, value: np.ndarray, shared: np.ndarray, *,
           device: str, dtype: torch.dtype) -> GramBlock:
        """The block of ``rows`` (m, k), readings ``value`` (m,) and shared rows (m, s)."""
        columns = sparse.csr_matrix(rows.T)
        gram = torch.as_tensor((columns @ rows).toarray(), device=device)
        near = gram.clone()
        near.diagonal().add_(_RIDGE * float(gram.diagonal().max()))
        right = torch.as_tensor(columns @ value, device=device)
        at = torch.cholesky_solve(right[:, None], torch.linalg.cholesky(near))[:, 0].cpu().numpy()
        left = value - rows @ at
        arrays = (gram, at, columns @ left, np.asarray(left @ left), columns @ shared, shared.T @ shared,
                  shared.T @ left)
        return cls(torch.as_tensor(particle, device=device),
                   *(torch.as_tensor(x, dtype=dtype, device=device) for x in arrays))

    @property
    def value(self) -> torch.Tensor:
        """Of the type and on the device of its numbers."""
        return self.at

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        return self.gram.numel()

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """As of `_ByReadings`. With y = P^-1 S A^T e and x = mean + S y the quadratic form is
        |z - U g - A x|^2 + |y|^2, and C^-1 e = z - U g - A x."""
        s, g = var.sqrt(), group_mean
        factor = _factored(self.gram, s)
        right = self.rest + self.gram @ (self.at - mean) - self.joint @ g
        y = torch.cholesky_solve(s[:, None] * torch.cat([right[:, None], self.joint], dim=1), factor)
        moved = s[:, None] * y
        apart = self.at - mean - moved[:, 0]
        pushed = self.gram @ torch.cat([apart[:, None], moved[:, 1:]], dim=1)
        along = self.rest + pushed[:, 0] - self.joint @ g
        across = self.met + self.joint.T @ apart - self.among @ g
        # |z - A at|^2 + 2 (z - A at)^T (A apart - U g) + |A apart - U g|^2, in which the last bracket is across + met
        # and along + rest, seen from U and A.
        left = self.size + apart @ (self.rest + along) - g @ (self.met + across)
        return Solved(2.0 * factor.diagonal().log().sum(), left + y[:, 0] @ y[:, 0],
                      self.among - self.joint.T @ moved[:, 1:], across,
                      torch.cat([along[:, None], self.joint - pushed[:, 1:]], dim=1), factor)

    def weighed(self, found: Solved, shift: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """As of `_ByReadings`."""
        return found.left[:, 0] - found.left[:, 1:] @ shift, found.across - found.inside @ shift

    def crossed(self, found: Solved) -> torch.Tensor:
        """As of `_ByReadings`."""
        return found.left[:, 1:]

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """As of `Block`."""
        return _sizes(self.gram, var, found)


@dataclass(frozen=True)
class Solved:
    """What the likelihood needs of a block's C^-1."""

    log_det: torch.Tensor
    """log det C."""
    quadratic: torch.Tensor
    """e^T C^-1 e."""
    inside: torch.Tensor
    """U^T C^-1 U (s, s)."""
    across: torch.Tensor
    """U^T C^-1 e (s,)."""
    left: torch.Tensor
    """C^-1 [e, U] (r, 1 + s), or A^T C^-1 [e, U] (k, 1 + s) of a `GramBlock`."""
    factor: torch.Tensor | Factor
    """Lower Cholesky factor of C, or of P where the block has a `gram`."""


@dataclass(frozen=True)
class _Inverted:
    """Solutions with the covariance C of a block."""

    log_det: torch.Tensor
    """log det C."""
    inverse: torch.Tensor
    """C^-1 right (r, c)."""
    quadratic: torch.Tensor
    """right_j^T C^-1 right_j (c,)."""
    factor: torch.Tensor | Factor
    """As of `Solved`."""


def particle_side(rows: int, particles: int) -> bool:
    """Whether a k x k factor and its inverse (k^3 operations) cost less than an r x r one and its product with the rows
    (3 r^2 k and r^3 / 3)."""
    return particles**3 < 3 * rows**2 * particles + rows**3 // 3


def _factored(gram: torch.Tensor, s: torch.Tensor) -> torch.Tensor:
    """Lower Cholesky factor of P = 1 + S G S (k, k), with S = diag(s)."""
    precision = gram * s
    precision *= s[:, None]
    precision.diagonal().add_(1.0)
    return torch.linalg.cholesky(precision)


def _sizes(gram: torch.Tensor, var: torch.Tensor, found: Solved) -> torch.Tensor:
    """a_j^T C^-1 a_j of every particle (k,), from the factor of P."""
    assert isinstance(found.factor, torch.Tensor)
    out = (1.0 - _inverse_diagonal(found.factor)) / var.clamp_min(1e-300)
    few = torch.nonzero(var <= _TINY * var.max())[:, 0]
    if len(few):
        cross = var.sqrt()[:, None] * gram[:, few]
        white = torch.linalg.solve_triangular(found.factor, cross, upper=False)
        out[few] = gram.diagonal()[few] - (white * white).sum(dim=0)
    return out


def _times(matrix: sparse.csr_matrix, right: np.ndarray) -> np.ndarray:
    """matrix @ right (n, c) column by column, which is faster for a few columns."""
    return np.stack([matrix @ np.ascontiguousarray(column) for column in right.T], axis=1) if right.shape[1] else (
        np.zeros((matrix.shape[0], 0)))


def _inverse_diagonal(factor: torch.Tensor) -> torch.Tensor:
    """Diagonal of (L L^T)^-1 (k,): the squared norms of the columns of L^-1, half the work of the inverse."""
    if factor.device.type != "cpu":
        return _inverse_diagonal_on_gpu(factor)
    upper = factor.numpy().T  # in Fortran's order without a copy
    (invert,) = linalg.get_lapack_funcs(("trtri",), (upper,))
    inverse = invert(upper, lower=0)[0]
    return torch.as_tensor(np.einsum("ij,ij->i", inverse, inverse))


def _inverse_diagonal_on_gpu(factor: torch.Tensor) -> torch.Tensor:
    one = torch.eye(len(factor), dtype=factor.dtype, device=factor.device)
    inverse = torch.linalg.solve_triangular(factor, one, upper=False)
    return (inverse * inverse).sum(dim=0)
