"""The marginal likelihood of SBML eq. 15, exactly, on the smallest matrices that hold it.

For one object, with readings z, observation matrix W, noise S = diag(s^2) and the prior of `composition`:

    NLL(mu, d) = 1/2 e^T C^-1 e + 1/2 log det C,   e = z - A mu,   C = A diag(d) A^T + S,   A = W B = [W, W G]

A, z and S do not change while the prior is learned, so the readings are divided by their noise and reduced once.
Touches that share no particle are independent blocks of C, apart from the few shared components, which Woodbury's
identity adds. An orthogonal matrix from the left splits the rows of a block into r that depend on the stiffnesses (r is
the rank of the rows, since the way out of a press repeats the way in) and a constant rest. The remaining work is
Cholesky factors of r x r blocks, or of k x k ones where a block has more readings than particles: with G = A^T A,
formed once, and S = diag(sqrt(d)),

    log det C = log det P,   C^-1 = 1 - A S P^-1 S A^T,   a_j^T C^-1 a_j = (1 - P^-1_jj) / d_j,   P = 1 + S G S

which needs products of G with a few vectors only. The gradient has the closed form

    dNLL/dmu = -A^T a,   dNLL/dd_j = 1/2 (a_j^T C^-1 a_j - (a_j^T a)^2),   a = C^-1 e,  a_j column j of A

so no computation graph is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import linalg, sparse
from scipy.sparse import csgraph

from vsfsim.core.errors import VsfError

_RANK = 1e-9
"""Singular values below this fraction of the largest are treated as zero: under a prior of a million times the noise
they add 1e-6 of the noise's variance."""
_RIDGE = 1e-12
"""Part of the largest diagonal entry of A^T A that is added to it, so that it has a factor."""


@dataclass(frozen=True)
class Solved:
    """What the likelihood needs of a block's C^-1, with e = z - A mean - U group_mean."""

    log_det: torch.Tensor
    """log det C."""
    inner: torch.Tensor
    """[e, U]^T C^-1 [e, U] (1 + s, 1 + s)."""
    left: torch.Tensor
    """A^T C^-1 [e, U] (k, 1 + s)."""
    sizes: Callable[[], torch.Tensor]
    """a_j^T C^-1 a_j of every particle (k,); a third of the work, and only the gradient needs it."""


@dataclass(frozen=True)
class ByReadings:
    """Touches that share particles, with no more readings than these, reduced by an orthogonal matrix."""

    particle: torch.Tensor
    """HE components that they move (k,)."""
    matrix: torch.Tensor
    """Reduced rows of W, A (r, k)."""
    value: torch.Tensor
    """Reduced readings (r,)."""
    shared: torch.Tensor
    """Reduced rows of W G, U (r, s)."""

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

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """What the likelihood needs, for the means and variances of its particles (k,) and the means of the shared
        components (s,)."""
        e = self.value - self.matrix @ mean - self.shared @ group_mean
        spread = (self.matrix * var) @ self.matrix.T
        spread.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(spread)
        white = torch.linalg.solve_triangular(factor, torch.cat([e[:, None], self.shared], dim=1), upper=False)
        left = self.matrix.T @ torch.linalg.solve_triangular(factor.T, white, upper=True)

        def sizes() -> torch.Tensor:
            return torch.linalg.solve_triangular(factor, self.matrix, upper=False).square().sum(dim=0)

        return Solved(2.0 * factor.diagonal().log().sum(), white.T @ white, left, sizes)


@dataclass(frozen=True)
class ByParticles:
    """Touches with more readings than particles, of which A^T A is kept, and no row.

    Readings enter by their distance from those of one point ``at`` near the least squares solution. What is written
    out here holds for any point; that it is near keeps large terms from cancelling.
    """

    particle: torch.Tensor
    """HE components that they move (k,)."""
    matrix: torch.Tensor
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
           device: str) -> ByParticles:
        """The block of ``rows`` (m, k), readings (m,) and shared rows (m, s)."""
        columns = sparse.csr_matrix(rows.T)
        gram = (columns @ rows).toarray()
        ridge = _RIDGE * max(float(gram.diagonal().max()), 1e-300) * np.eye(len(gram))
        at = linalg.solve(gram + ridge, columns @ value, assume_a="pos")
        left = value - rows @ at
        arrays = (particle, gram, at, columns @ left, np.asarray(left @ left), columns @ shared, shared.T @ shared,
                  shared.T @ left)
        return cls(*(torch.as_tensor(x, device=device) for x in arrays))

    def solved(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor) -> Solved:
        """As of `ByReadings`. With P = 1 + S G S, S = diag(sqrt(var)), y = P^-1 S A^T e and x = mean + S y the
        quadratic form is |z - U g - A x|^2 + |y|^2, and C^-1 e = z - U g - A x."""
        s, g = var.sqrt(), group_mean
        precision = self.matrix * s
        precision *= s[:, None]
        precision.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(precision)
        right = self.rest + self.matrix @ (self.at - mean) - self.joint @ g
        y = torch.cholesky_solve(s[:, None] * torch.cat([right[:, None], self.joint], dim=1), factor)
        moved = s[:, None] * y
        apart = self.at - mean - moved[:, 0]
        pushed = self.matrix @ torch.cat([apart[:, None], moved[:, 1:]], dim=1)
        along = self.rest + pushed[:, 0] - self.joint @ g
        across = self.met + self.joint.T @ apart - self.among @ g
        # |z - A at|^2 + 2 (z - A at)^T (A apart - U g) + |A apart - U g|^2, in which the last bracket is across + met
        # and along + rest, seen from U and A.
        own = self.size + apart @ (self.rest + along) - g @ (self.met + across) + y[:, 0] @ y[:, 0]
        inner = torch.cat([torch.cat([own[None], across])[None],
                           torch.cat([across[:, None], self.among - self.joint.T @ moved[:, 1:]], dim=1)])

        def sizes() -> torch.Tensor:
            return (1.0 - torch.cholesky_inverse(factor).diagonal()) / var

        return Solved(2.0 * factor.diagonal().log().sum(), inner,
                      torch.cat([along[:, None], self.joint - pushed[:, 1:]], dim=1), sizes)


@dataclass(frozen=True)
class Evidence:
    """The readings of one object, reduced."""

    touched: np.ndarray
    """Particles that some reading moves (k,) int."""
    blocks: tuple[ByReadings | ByParticles, ...]
    """Independent groups of touches."""
    constant: float
    """The part of the NLL that does not depend on the prior, in nats [-]."""
    readings: int
    """Number of readings."""
    shared: int
    """Number of shared components, s."""

    @classmethod
    def of(cls, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float,
           membership: sparse.csr_matrix | None = None,
           touch: np.ndarray | None = None, device: str = "cpu") -> Evidence:
        """Reduce the readings of one object.

        Args:
            w: observation matrix (m, n).
            z: readings (m,), finite.
            noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
            membership: G (n, s) of the shared components, or None.
            touch: number of the touch of each reading (m,) int; None if all readings belong to one.
            device: torch's, of the likelihood.

        Raises:
            VsfError: shapes that do not fit, or a reading that is not finite.
        """
        w = sparse.csr_matrix(w, dtype=np.float64, copy=True)
        w.eliminate_zeros()
        m, n = w.shape
        z = np.asarray(z, np.float64)
        noise = np.broadcast_to(np.asarray(noise_std, np.float64), (m,))
        touch = np.zeros(m, int) if touch is None else np.asarray(touch)
        g = sparse.csr_matrix((n, 0)) if membership is None else sparse.csr_matrix(membership, dtype=np.float64)
        if z.shape != (m,) or touch.shape != (m,) or g.shape[0] != n:
            raise VsfError(f"vsf.evidence: W is {m} x {n}, z {z.shape}, touch {touch.shape}, membership {g.shape}; "
                           f"they must fit.")
        if not (np.isfinite(z).all() and np.isfinite(w.data).all() and (noise > 0.0).all()):
            raise VsfError("vsf.evidence: readings and rows must be finite and noise_std greater than 0; remove "
                           "readings that are not.")
        a, b = sparse.csr_matrix(sparse.diags_array(1.0 / noise) @ w), z / noise
        touched = np.flatnonzero(np.diff(a.tocsc().indptr))
        place = np.full(n, -1)
        place[touched] = np.arange(len(touched))
        ag = (a @ g).toarray()
        constant = float(np.log(noise).sum()) + 0.5 * m * np.log(2.0 * np.pi)
        blocks: list[ByReadings | ByParticles] = []
        for rows in _groups(a, touch):
            moved = np.unique(a[rows].indices)
            if not len(moved):
                constant += 0.5 * float(b[rows] @ b[rows])
                continue
            given = place[moved], sparse.csr_matrix(a[rows][:, moved]), b[rows], ag[rows]
            if len(rows) > len(moved):
                blocks.append(ByParticles.of(*given, device=device))
            else:
                block, unexplained = ByReadings.of(*given, device=device)
                blocks.append(block)
                constant += unexplained
        return cls(touched, tuple(blocks), constant, m, g.shape[1])

    def nll(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor | None = None,
            group_var: torch.Tensor | None = None) -> torch.Tensor:
        """Negative log-likelihood of the readings, constants included (a scalar, differentiable).

        Args:
            mean, var: of the heterogeneous components of `touched` (k,), var > 0.
            group_mean, group_var: of the shared components (s,), or None without any.
        """
        device = self.blocks[0].particle.device if self.blocks else mean.device
        none = torch.zeros(0)
        given = [mean, var, none if group_mean is None else group_mean, none if group_var is None else group_var]
        return _MarginalNll.apply(self, *(x.to(dtype=torch.float64, device=device) for x in given)) + self.constant


class _MarginalNll(torch.autograd.Function):
    """Value and closed-form gradient of eq. 15."""

    @staticmethod
    def forward(ctx, evidence, mean, var, group_mean, group_var):
        s = len(group_mean)
        root = group_var.clamp_min(0.0).sqrt()
        # C = blockdiag(C_b) + U diag(group_var) U^T; inner sums [e, U]^T C_b^-1 [e, U].
        solved = [(block.particle, block.solved(mean[block.particle], var[block.particle], group_mean))
                  for block in evidence.blocks]
        inner = sum((found.inner for _, found in solved), mean.new_zeros(1 + s, 1 + s))
        across, inside = inner[1:, 0], inner[1:, 1:]
        small = torch.eye(s, dtype=mean.dtype, device=mean.device) + root[:, None] * inside * root
        factor = torch.linalg.cholesky(0.5 * (small + small.T))
        half = torch.linalg.solve_triangular(factor, (root * across)[:, None], upper=False)
        value = 0.5 * (inner[0, 0] + sum((found.log_det for _, found in solved), mean.new_zeros(()))
                       - half.square().sum()) + factor.diagonal().log().sum()
        if any(ctx.needs_input_grad):
            # a = C^-1 e, seen from the members of the shared components and from the particles
            shift = root * torch.cholesky_solve((root * across)[:, None], factor)[:, 0]
            pull = across - inside @ shift
            grad_mean, grad_var = torch.zeros_like(mean), torch.zeros_like(var)
            for particle, found in solved:
                along = found.left[:, 0] - found.left[:, 1:] @ shift
                cross = torch.linalg.solve_triangular(factor, root[:, None] * found.left[:, 1:].T, upper=False)
                grad_mean.index_add_(0, particle, -along)
                grad_var.index_add_(0, particle, 0.5 * (found.sizes() - cross.square().sum(dim=0) - along.square()))
            # u^T C^-1 u = (K^-1 + diag(group_var))^-1 on the diagonal, with K = U^T blockdiag(C)^-1 U.
            reduced = torch.linalg.solve_triangular(factor, root[:, None] * inside, upper=False)
            ctx.save_for_backward(grad_mean, grad_var, -pull, 0.5 * (
                inside.diagonal() - reduced.square().sum(dim=0) - pull.square()))
        return value

    @staticmethod
    def backward(ctx, above):
        return None, *(above * gradient for gradient in ctx.saved_tensors)


def _groups(a: sparse.csr_matrix, touch: np.ndarray) -> list[np.ndarray]:
    """Readings by connected component of touches; a particle that two touches move connects them."""
    names, index = np.unique(touch, return_inverse=True)
    incidence = sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(len(names), len(index)))
    moves = incidence @ abs(a)
    count, label = csgraph.connected_components(moves @ moves.T, directed=False)
    return [np.flatnonzero(label[index] == k) for k in range(count)]
