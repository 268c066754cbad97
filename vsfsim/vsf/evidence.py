"""The marginal likelihood of SBML eq. 15, exactly, on the smallest matrices that hold it.

For one object, with readings z, observation matrix W, noise S = diag(s^2) and the prior of `composition`:

    NLL(mu, d) = 1/2 e^T C^-1 e + 1/2 log det C,   e = z - A mu,   C = A diag(d) A^T + S,   A = W B = [W, W G]

A, z and S never change while the prior is learned, so the readings are first divided by their noise and then turned: an orthogonal
matrix from the left splits a touch's rows into r that depend on the stiffnesses (r = the rank of the rows: the way out of a
press repeats the way in) and the rest, which is constant. Touches that share no particle are independent blocks of C but for
the few shared components, which come in by Woodbury's identity. What remains are Cholesky factors of r x r blocks.
The gradient is the closed form

    dNLL/dmu = -A^T a,   dNLL/dd_j = 1/2 (a_j^T C^-1 a_j - (a_j^T a)^2),   a = C^-1 e,  a_j column j of A

so no graph is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph

from vsfsim.vsf.dynamics import VsfError

# Singular values under this fraction of the largest are rounding: with a prior a million times the noise they would still add
# only 1e-6 of the noise's variance.
_RANK = 1e-9


@dataclass(frozen=True)
class _Block:
    """Touches that share particles. particle: HE components they move (k,). rows: turned rows of W (r, k). value: turned readings (r,).
    shared: turned rows of W G (r, s)."""

    particle: torch.Tensor
    rows: torch.Tensor
    value: torch.Tensor
    shared: torch.Tensor


@dataclass(frozen=True)
class Evidence:
    """The readings of one object, reduced.

    touched: particles that some reading moves (k,) int. blocks: independent groups of touches. constant: what no prior changes, in nats [-].
    readings: how many there were. shared: components beside the heterogeneous ones, s.
    """

    touched: np.ndarray
    blocks: tuple[_Block, ...]
    constant: float
    readings: int
    shared: int

    @classmethod
    def of(cls, w: sparse.csr_matrix, z: np.ndarray, *, noise_std: np.ndarray | float, membership: sparse.csr_matrix | None = None,
           touch: np.ndarray | None = None, device: str = "cpu", dtype: torch.dtype = torch.float64) -> Evidence:
        """Reduce the readings of one object.

        Args:
            w: observation matrix (m, n). z: readings (m,), finite. noise_std: > 0, (m,) or one number, in the unit of z.
            membership: G (n, s) of the shared components, or None.
            touch: number of the touch of each reading (m,) int; None: all readings belong to one.
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
            raise VsfError(f"vsf.evidence: W is {m} x {n}, z {z.shape}, touch {touch.shape}, membership {g.shape}; they must fit.")
        if not (np.isfinite(z).all() and np.isfinite(w.data).all() and (noise > 0.0).all()):
            raise VsfError("vsf.evidence: readings and rows must be finite and noise_std greater than 0; remove readings that are not.")
        a, b = sparse.csr_matrix(sparse.diags_array(1.0 / noise) @ w), z / noise
        touched = np.flatnonzero(np.diff(a.tocsc().indptr))
        place = np.full(n, -1)
        place[touched] = np.arange(len(touched))
        ag = (a @ g).toarray()
        constant = float(np.log(noise).sum()) + 0.5 * m * np.log(2.0 * np.pi)
        blocks = []
        scale = np.abs(a.data).max() if a.nnz else 0.0
        for rows in _groups(a, touch):
            parts = [_turned(a[part], ag[part], b[part], scale) for part in rows]
            constant += sum(part[-1] for part in parts)
            block, extra = _joined([part[:-1] for part in parts], scale)
            constant += extra
            if block is not None:
                columns, dense, shared, value = block
                blocks.append(_Block(*(torch.as_tensor(x, device=device) for x in (place[columns],)),
                                     *(torch.as_tensor(np.ascontiguousarray(x), dtype=dtype, device=device) for x in (dense, value, shared))))
        return cls(touched, tuple(blocks), constant, m, g.shape[1])

    def nll(self, mean: torch.Tensor, var: torch.Tensor, group_mean: torch.Tensor | None = None,
            group_var: torch.Tensor | None = None) -> torch.Tensor:
        """Negative log-likelihood of the readings, constants included (a scalar, differentiable).

        Args:
            mean, var: of the heterogeneous components of `touched` (k,), var >= 0.
            group_mean, group_var: of the shared components (s,), or None without any.
        """
        like = self.blocks[0].rows if self.blocks else mean
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
        # C = blockdiag(L L^T) + U diag(group_var) U^T; white: L^-1 of each part.
        small = torch.eye(s, dtype=mean.dtype, device=mean.device)
        projected = torch.zeros(s, dtype=mean.dtype, device=mean.device)
        kept = []
        for block in evidence.blocks:
            d = var[block.particle]
            c = (block.rows * d) @ block.rows.T
            c.diagonal().add_(1.0)
            factor = torch.linalg.cholesky(c)
            e = block.value - block.rows @ mean[block.particle] - block.shared @ group_mean
            white_e = torch.linalg.solve_triangular(factor, e[:, None], upper=False)[:, 0]
            white_u = torch.linalg.solve_triangular(factor, block.shared * root, upper=False)
            value = value + 0.5 * (white_e @ white_e) + factor.diagonal().log().sum()
            small = small + white_u.T @ white_u
            projected = projected + white_u.T @ white_e
            kept.append((block, factor, white_e, white_u))
        if s:
            small_factor = torch.linalg.cholesky(small)
            half = torch.linalg.solve_triangular(small_factor, projected[:, None], upper=False)
            value = value - 0.5 * (half * half).sum() + small_factor.diagonal().log().sum()
        if need:
            grad_mean, grad_var = torch.zeros_like(mean), torch.zeros_like(var)
            grad_group, grad_group_var = torch.zeros_like(group_mean), torch.zeros_like(group_var)
            shift = torch.cholesky_solve(projected[:, None], small_factor)[:, 0] if s else projected
            inside = torch.zeros(s, s, dtype=mean.dtype, device=mean.device)  # U^T blockdiag(C)^-1 U, without the root
            pull = torch.zeros_like(group_mean)
            for block, factor, white_e, white_u in kept:
                alpha = torch.linalg.solve_triangular(factor.T, (white_e - white_u @ shift)[:, None], upper=True)[:, 0]
                white = torch.linalg.solve_triangular(factor, block.rows, upper=False)
                size = (white * white).sum(dim=0)
                if s:
                    cross = torch.linalg.solve_triangular(small_factor, white_u.T @ white, upper=False)
                    size = size - (cross * cross).sum(dim=0)
                    plain = torch.linalg.solve_triangular(factor, block.shared, upper=False)
                    inside = inside + plain.T @ plain
                    pull = pull + block.shared.T @ alpha
                along = block.rows.T @ alpha
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
    """Touches (their rows) by connected component: two touches are joined by a particle that both move."""
    names, index = np.unique(touch, return_inverse=True)
    incidence = sparse.csr_matrix((np.ones(len(index)), (index, np.arange(len(index)))), shape=(len(names), len(index)))
    moves = incidence @ abs(a)
    label = csgraph.connected_components(moves @ moves.T, directed=False)[1]
    rows = [np.flatnonzero(index == t) for t in range(len(names))]
    return [[rows[t] for t in np.flatnonzero(label == k)] for k in range(label.max() + 1 if len(label) else 0)]


def _turned(a: sparse.csr_matrix, ag: np.ndarray, b: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Columns (k,), rows (r, k), shared rows (r, s) and readings (r,) of one touch, and 1/2 |readings that no stiffness explains|^2."""
    columns = np.unique(a.indices)
    dense = a[:, columns].toarray()
    turn, size, right = np.linalg.svd(dense, full_matrices=False) if dense.size else (np.zeros((len(b), 0)), np.zeros(0), np.zeros((0, 0)))
    keep = size > _RANK * scale
    turn = turn[:, keep]
    value = turn.T @ b
    return columns, size[keep, None] * right[keep], turn.T @ ag, value, 0.5 * max(float(b @ b - value @ value), 0.0)


def _joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]], scale: float) -> tuple[tuple | None, float]:
    """One block of several touches; with more rows than particles it is turned once more."""
    columns = np.unique(np.concatenate([part[0] for part in parts]))
    count = sum(len(part[3]) for part in parts)
    if count == 0:
        return None, 0.0
    dense, start = np.zeros((count, len(columns))), 0
    for own, rows, _, value in parts:
        dense[start:start + len(value), np.searchsorted(columns, own)] = rows
        start += len(value)
    shared, value = np.concatenate([part[2] for part in parts]), np.concatenate([part[3] for part in parts])
    if count <= len(columns):
        return (columns, dense, shared, value), 0.0
    turned = _turned(sparse.csr_matrix(dense), shared, value, scale)
    return (columns[turned[0]], *turned[1:4]), turned[4]
