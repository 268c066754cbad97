"""Independent groups of touches in SBML's eq. 15: the covariance of their readings, on the smaller side.

`vsfsim.vsf.estimate.evidence` says what is computed; here is how a group's C is factored and used. Both kinds of blocks
answer the same questions: `solved`, `weighed`, `crossed` and `sizes`, where A are the group's rows, U = A G those of
its shared components, and e = z - A mean - U group_mean.

    ByReadings    rows, reduced by an orthogonal matrix, where a group has no more readings than particles
    ByParticles   A^T A alone, and no row, where it has more: dense, or by fronts where touches each move few of the
                  particles
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse

from vsfsim.vsf.estimate.fronts import Factor, Fronts

_RANK = 1e-9
"""Singular values below this fraction of the largest are treated as zero: under a prior of a million times the noise
they add 1e-6 of the noise's variance."""
_TINY = 1e-10
"""Prior variances below this fraction of the largest, where (1 - P^-1_jj) / d_j is a quotient of rounding errors."""
_FEW = 128
"""Particles of a block up to which a dense matrix is factored in any case."""
_FILLED = 0.4
"""Share of a dense factor's work up to which fronts are taken."""
_RIDGE = 1e-12
"""Part of the largest diagonal entry of A^T A that is added to it, so that it has a factor."""


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
    """A^T C^-1 [e, U] (k, 1 + s)."""
    factor: torch.Tensor | Factor
    """Lower Cholesky factor of C, or a factor of P of `ByParticles`."""

    def weighed(self, shift: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """A^T a (k,) and U^T a (s,) of a = C^-1 (e - U shift)."""
        return self.left[:, 0] - self.left[:, 1:] @ shift, self.across - self.inside @ shift


@dataclass(frozen=True)
class ByReadings:
    """Touches that share particles, reduced by an orthogonal matrix."""

    particle: torch.Tensor
    """HE components that they move (k,)."""
    rows: torch.Tensor
    """Reduced rows of W (r, k)."""
    value: torch.Tensor
    """Reduced readings (r,)."""
    shared: torch.Tensor
    """Reduced rows of W G (r, s)."""

    @classmethod
    def of(cls, particle: np.ndarray, rows: sparse.csr_matrix, value: np.ndarray, shared: np.ndarray, *,
           device: str) -> tuple[ByReadings, float]:
        """The block of ``rows`` (m, k), readings (m,) and shared rows (m, s), and 1/2 |readings that no stiffness
        explains|^2."""
        left, size, right = np.linalg.svd(rows.toarray(), full_matrices=False)
        keep = size > _RANK * size[0]
        left = left[:, keep]
        reduced = left.T @ value
        block = cls(*(torch.as_tensor(x, device=device)
                      for x in (particle, size[keep, None] * right[keep], reduced, left.T @ shared)))
        return block, 0.5 * max(float(value @ value - reduced @ reduced), 0.0)

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        return self.rows.numel()

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """What the likelihood needs of C^-1, for the means and variances of its particles (k,) and the means of the
        shared components (s,)."""
        e = self.value - self.rows @ mean - self.shared @ group_mean
        spread = (self.rows * var) @ self.rows.T
        spread.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(spread)
        white = torch.linalg.solve_triangular(factor, torch.cat([e[:, None], self.shared], dim=1), upper=False)
        inside = white.T @ white
        left = self.rows.T @ torch.linalg.solve_triangular(factor.T, white, upper=True)
        return Solved(2.0 * factor.diagonal().log().sum(), inside[0, 0], inside[1:, 1:], inside[1:, 0], left, factor)

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """a_j^T C^-1 a_j of every particle (k,)."""
        white = torch.linalg.solve_triangular(found.factor, self.rows, upper=False)
        return (white * white).sum(dim=0)


@dataclass(frozen=True)
class ByParticles:
    """Touches of which A^T A is kept, and no row.

    Readings enter by their distance from those of one point ``at`` near the least squares solution. What is written
    out here holds for any point; that it is near keeps large terms from cancelling.
    """

    particle: torch.Tensor
    """HE components that they move (k,)."""
    gram: torch.Tensor | sparse.csr_matrix
    """G = A^T A (k, k), sparse with `fronts`."""
    fronts: Fronts | None
    """Order in which G is factored on a CPU, None if dense."""
    entries: np.ndarray
    """Entries of G in the order of ``fronts`` (q,)."""
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
           device: str) -> ByParticles:
        """The block of ``rows`` (m, k), readings (m,) and shared rows (m, s)."""
        columns = sparse.csr_matrix(rows.T)
        found = sparse.csr_matrix(columns @ rows)
        size, fronts, entries = len(particle), None, np.zeros(0)
        if device == "cpu" and size > _FEW:
            fronts = Fronts.of(found)
            fronts = fronts if fronts.work <= _FILLED * size**3 / 6 else None
        if fronts is not None:
            entries = found.data[fronts.kept]
        gram = torch.as_tensor(found.toarray(), device=device) if fronts is None else found
        block = cls(torch.as_tensor(particle, device=device), gram, fronts, entries, *[torch.zeros(0)] * 6)
        wide = torch.full((size,), (_RIDGE * max(float(found.diagonal().max()), 1e-300)) ** -0.5, dtype=torch.float64,
                          device=device)
        right = torch.as_tensor(columns @ value, device=device)
        at = (wide * block._solve(block._factored(wide), (wide * right)[:, None])[:, 0]).cpu().numpy()
        left = value - rows @ at
        arrays = (at, columns @ left, np.asarray(left @ left), columns @ shared, shared.T @ shared, shared.T @ left)
        return cls(block.particle, gram, fronts, entries, *(torch.as_tensor(x, device=device) for x in arrays))

    @property
    def largest(self) -> int:
        """Entries of its largest dense matrix."""
        if self.fronts is None:
            return self.gram.numel()
        return max((len(front.own) + len(front.border))**2 for front in self.fronts.fronts)

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """As of `ByReadings`. With P = 1 + S G S, S = diag(sqrt(var)), y = P^-1 S A^T e and x = mean + S y the
        quadratic form is |z - U g - A x|^2 + |y|^2, and C^-1 e = z - U g - A x."""
        s, g = var.sqrt(), group_mean
        factor = self._factored(s)
        right = self.rest + self._pushed((self.at - mean)[:, None])[:, 0] - self.joint @ g
        y = self._solve(factor, s[:, None] * torch.cat([right[:, None], self.joint], dim=1))
        moved = s[:, None] * y
        apart = self.at - mean - moved[:, 0]
        pushed = self._pushed(torch.cat([apart[:, None], moved[:, 1:]], dim=1))
        along = self.rest + pushed[:, 0] - self.joint @ g
        across = self.met + self.joint.T @ apart - self.among @ g
        # |z - A at|^2 + 2 (z - A at)^T (A apart - U g) + |A apart - U g|^2, in which the last bracket is across + met
        # and along + rest, seen from U and A.
        left = self.size + apart @ (self.rest + along) - g @ (self.met + across)
        log_det = (torch.tensor(factor.log_det, dtype=var.dtype) if isinstance(factor, Factor)
                   else 2.0 * factor.diagonal().log().sum())
        return Solved(log_det, left + y[:, 0] @ y[:, 0], self.among - self.joint.T @ moved[:, 1:], across,
                      torch.cat([along[:, None], self.joint - pushed[:, 1:]], dim=1), factor)

    def sizes(self, var: torch.Tensor, found: Solved) -> torch.Tensor:
        """As of `ByReadings`."""
        inverse = (torch.as_tensor(found.factor.inverse_diagonal()) if isinstance(found.factor, Factor)
                   else _inverse_diagonal(found.factor))
        out = (1.0 - inverse) / var.clamp_min(1e-300)
        few = torch.nonzero(var <= _TINY * var.max())[:, 0]
        if len(few):
            one = torch.zeros((len(var), len(few)), dtype=var.dtype, device=var.device)
            one[few, torch.arange(len(few), device=var.device)] = 1.0
            column = self._pushed(one)
            cross = var.sqrt()[:, None] * column
            out[few] = (column * one).sum(dim=0) - (cross * self._solve(found.factor, cross)).sum(dim=0)
        return out

    def _pushed(self, moved: torch.Tensor) -> torch.Tensor:
        """G ``moved`` (k, c)."""
        if self.fronts is None:
            return self.gram @ moved
        # column by column, which is faster for a few of them
        return torch.as_tensor(np.stack([self.gram @ np.ascontiguousarray(x) for x in moved.numpy().T], axis=1))

    def _factored(self, s: torch.Tensor) -> torch.Tensor | Factor:
        """Of P = 1 + S G S (k, k)."""
        if self.fronts is not None:
            scale = s.numpy()
            return self.fronts.factor(self.entries * scale[self.fronts.row] * scale[self.fronts.column])
        precision = self.gram * s
        precision *= s[:, None]
        precision.diagonal().add_(1.0)
        return torch.linalg.cholesky(precision)

    def _solve(self, factor: torch.Tensor | Factor, right: torch.Tensor) -> torch.Tensor:
        """P^-1 ``right`` (k, c)."""
        if isinstance(factor, Factor):
            return torch.as_tensor(factor.solve(right.numpy()))
        return torch.cholesky_solve(right, factor)


def _inverse_diagonal(factor: torch.Tensor) -> torch.Tensor:
    """Diagonal of (L L^T)^-1 (k,): the squared norms of the columns of L^-1, half the work of the inverse."""
    if factor.device.type == "cpu":
        inverse = linalg.lapack.dtrtri(factor.numpy().T, lower=0)[0]  # in Fortran's order without a copy
        return torch.as_tensor(np.einsum("ij,ij->i", inverse, inverse))
    one = torch.eye(len(factor), dtype=factor.dtype, device=factor.device)
    inverse = torch.linalg.solve_triangular(factor, one, upper=False)
    return (inverse * inverse).sum(dim=0)
