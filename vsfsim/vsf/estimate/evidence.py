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

which needs products of G with a few vectors only. Where many touches each move few of a block's particles, P is sparse,
and on a CPU a factor by `fronts` takes a hundredth of the work. The gradient has the closed form

    dNLL/dmu = -A^T a,   dNLL/dd_j = 1/2 (a_j^T C^-1 a_j - (a_j^T a)^2),   a = C^-1 e,  a_j column j of A

so no computation graph is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.touch_blocks import ByParticles, ByReadings


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
            mean, var: of the heterogeneous components of `touched` (k,), var >= 0.
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
        need = any(ctx.needs_input_grad)
        value = torch.zeros((), dtype=mean.dtype, device=mean.device)
        s = len(group_mean)
        root = group_var.clamp_min(0.0).sqrt()
        # C = blockdiag(C_b) + U diag(group_var) U^T; inside: U^T blockdiag(C_b)^-1 U, across: U^T blockdiag(C_b)^-1 e.
        inside = torch.zeros(s, s, dtype=mean.dtype, device=mean.device)
        across = torch.zeros(s, dtype=mean.dtype, device=mean.device)
        kept = []
        for block in evidence.blocks:
            found = block.solved(mean[block.particle], var[block.particle], group_mean)
            value = value + 0.5 * (found.quadratic + found.log_det)
            inside = inside + found.inside
            across = across + found.across
            kept.append((block, found))
        if s:
            small = torch.eye(s, dtype=mean.dtype, device=mean.device) + root[:, None] * inside * root
            small_factor = torch.linalg.cholesky(0.5 * (small + small.T))
            half = torch.linalg.solve_triangular(small_factor, (root * across)[:, None], upper=False)
            value = value - 0.5 * (half * half).sum() + small_factor.diagonal().log().sum()
        if need:
            grad_mean, grad_var = torch.zeros_like(mean), torch.zeros_like(var)
            grad_group, grad_group_var = torch.zeros_like(group_mean), torch.zeros_like(group_var)
            shift = root * torch.cholesky_solve((root * across)[:, None], small_factor)[:, 0] if s else across
            pull = torch.zeros_like(group_mean)
            for block, found in kept:
                along, own = found.weighed(shift)
                size = block.sizes(var[block.particle], found)
                if s:
                    crossed = root[:, None] * found.left[:, 1:].T
                    cross = torch.linalg.solve_triangular(small_factor, crossed, upper=False)
                    size = size - (cross * cross).sum(dim=0)
                    pull = pull + own
                grad_mean.index_add_(0, block.particle, -along)
                grad_var.index_add_(0, block.particle, 0.5 * (size - along * along))
            if s:
                # u^T C^-1 u = (K^-1 + diag(group_var))^-1 on the diagonal, with K = U^T blockdiag(C)^-1 U.
                reduced = torch.linalg.solve_triangular(small_factor, root[:, None] * inside, upper=False)
                grad_group = -pull
                grad_group_var = 0.5 * (inside.diagonal() - (reduced * reduced).sum(dim=0) - pull * pull)
            ctx.save_for_backward(grad_mean, grad_var, grad_group, grad_group_var)
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
