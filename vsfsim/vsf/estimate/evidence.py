"""The marginal likelihood of SBML eq. 15, exactly, on the smallest matrices that hold it.

For one object, with readings z, observation matrix W, noise S = diag(s^2) and the prior of `composition`:

    NLL(mu, d) = 1/2 e^T C^-1 e + 1/2 log det C,   e = z - A mu,   C = A diag(d) A^T + S,   A = W B = [W, W G]

A, z and S do not change while the prior is learned, so the readings are divided by their noise and reduced once. An
orthogonal matrix from the left splits the rows of a touch into r that depend on the stiffnesses (r is the rank of the
rows, since the way out of a press repeats the way in) and a constant rest. Touches that share no particle are
independent blocks of C, apart from the few shared components, which Woodbury's identity adds. The remaining work is
Cholesky factors of r x r blocks, or of k x k ones where a block has about as many rows as particles: with G = A^T A,
formed once, and S = diag(sqrt(d)),

    log det C = log det P,   C^-1 = 1 - A S P^-1 S A^T,   a_j^T C^-1 a_j = (1 - P^-1_jj) / d_j,   P = 1 + S G S

which needs products of A with a few vectors only. Where many touches each move few of a block's particles, P is sparse,
and a factor by `fronts` takes a hundredth of the work; its readings are then not reduced. A GPU factors the dense P in
less time, and keeps no rows at all (`touch_blocks.GramBlock`). The gradient has the closed form

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
from vsfsim.vsf.estimate.touch_blocks import FEW, Block, GramBlock, SparseBlock, particle_side

_RANK = 1e-9
"""Singular values below this fraction of the largest are treated as zero: under a prior of a million times the noise
they add 1e-6 of the noise's variance."""


@dataclass(frozen=True)
class Evidence:
    """The readings of one object, reduced."""

    touched: np.ndarray
    """Particles that some reading moves (k,) int."""
    blocks: tuple[Block | SparseBlock | GramBlock, ...]
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
           touch: np.ndarray | None = None, device: str = "cpu", dtype: torch.dtype = torch.float64) -> Evidence:
        """Reduce the readings of one object.

        Args:
            w: observation matrix (m, n).
            z: readings (m,), finite.
            noise_std: standard deviation of the readings, > 0 (m,) or one number, in the unit of z.
            membership: G (n, s) of the shared components, or None.
            touch: number of the touch of each reading (m,) int; None if all readings belong to one.
            device, dtype: torch's, of the likelihood.

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
        blocks: list[Block | SparseBlock | GramBlock] = []
        scale = np.abs(a.data).max() if a.nnz else 0.0
        for rows in _groups(a, touch):
            every = np.concatenate(rows)
            mine = a[every]
            moved = np.unique(mine.indices)
            known: SparseBlock | GramBlock | None = None
            if device != "cpu" and FEW < len(moved) <= len(every):
                known = GramBlock.of(place[moved], sparse.csr_matrix(mine[:, moved]), b[every], ag[every],
                                     device=device, dtype=dtype)
            elif device == "cpu" and dtype == torch.float64:
                known = SparseBlock.of(place[moved], sparse.csr_matrix(mine[:, moved]), b[every], ag[every])
            if known is not None:
                blocks.append(known)
                continue
            parts = [_reduced(a[part], ag[part], b[part], scale) for part in rows]
            constant += sum(part[-1] for part in parts)
            (columns, dense, shared, value), extra = _joined([part[:-1] for part in parts], scale)
            constant += extra
            if len(value):
                by_particles = particle_side(*dense.shape)
                dense = torch.as_tensor(dense, dtype=dtype, device=device)
                blocks.append(Block(torch.as_tensor(place[columns], device=device), dense,
                                    torch.as_tensor(value, dtype=dtype, device=device),
                                    torch.as_tensor(np.ascontiguousarray(shared), dtype=dtype, device=device),
                                    dense.T @ dense if by_particles else None))
        return cls(touched, tuple(blocks), constant, m, g.shape[1])

    def nll(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor | None = None,
            group_var: torch.Tensor | None = None) -> torch.Tensor:
        """Negative log-likelihood of the readings, constants included (a scalar, differentiable).

        Args:
            mean, var: of the heterogeneous components of `touched` (k,), var >= 0.
            group_mean, group_var: of the shared components (s,), or None without any.
        """
        like = self.blocks[0].value if self.blocks else mean
        none = torch.zeros(0, dtype=like.dtype, device=like.device)
        given = [mean, var, none if group_mean is None else group_mean, none if group_var is None else group_var]
        return _MarginalNll.apply(self, *(x.to(dtype=like.dtype, device=like.device) for x in given)) + self.constant


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
                along, own = block.weighed(found, shift)
                size = block.sizes(var[block.particle], found)
                if s:
                    cross = torch.linalg.solve_triangular(small_factor,
                                                          root[:, None] * block.crossed(found).T,
                                                          upper=False)
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


def _groups(a: sparse.csr_matrix, touch: np.ndarray) -> list[list[np.ndarray]]:
    """Touches (their rows) by connected component; a particle that two touches move connects them."""
    names, index = np.unique(touch, return_inverse=True)
    incidence = sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(len(names), len(index)))
    moves = incidence @ abs(a)
    label = csgraph.connected_components(moves @ moves.T, directed=False)[1]
    rows = [np.flatnonzero(index == t) for t in range(len(names))]
    return [[rows[t] for t in np.flatnonzero(label == k)] for k in range(label.max() + 1 if len(label) else 0)]


def _reduced(a: sparse.csr_matrix, ag: np.ndarray, b: np.ndarray,
            scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Columns (k,), rows (r, k), shared rows (r, s) and readings (r,) of one touch, and 1/2 |readings that no stiffness
    explains|^2."""
    columns = np.unique(a.indices)
    dense = a[:, columns].toarray()
    if dense.size:
        left, size, right = np.linalg.svd(dense, full_matrices=False)
    else:
        left, size, right = np.zeros((len(b), 0)), np.zeros(0), np.zeros((0, 0))
    keep = size > _RANK * scale
    left = left[:, keep]
    value = left.T @ b
    return columns, size[keep, None] * right[keep], left.T @ ag, value, 0.5 * max(float(b @ b - value @ value), 0.0)


def _joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
            scale: float) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], float]:
    """Several touches as one, like `_reduced`; with many more rows than particles they are reduced again."""
    columns = np.unique(np.concatenate([part[0] for part in parts]))
    dense, start = np.zeros((sum(len(part[3]) for part in parts), len(columns))), 0
    for own, rows, _, value in parts:
        dense[start:start + len(value), np.searchsorted(columns, own)] = rows
        start += len(value)
    shared, value = np.concatenate([part[2] for part in parts]), np.concatenate([part[3] for part in parts])
    if len(dense) <= 2 * len(columns):
        return (columns, dense, shared, value), 0.0
    reduced = _reduced(sparse.csr_matrix(dense), shared, value, scale)
    return (columns[reduced[0]], *reduced[1:4]), reduced[4]
