"""The stiffness of the contact points on the nodes of the patches, and its inverse together with the compliance of the
body at rest."""

from __future__ import annotations

from dataclasses import dataclass

import scipy.sparse as sp
import torch


@dataclass(frozen=True)
class SparseStiffness:
    """The stiffness C of k patches on a CPU, as an operator: ``stiffness @ v`` for v (k, 3 s, 1)."""

    matrices: list[sp.csr_matrix]
    """Of each touch (3 s, 3 s) [N/m]."""

    def __getitem__(self, which: torch.Tensor) -> SparseStiffness:
        return SparseStiffness([self.matrices[b] for b in _entries(which)])

    def __matmul__(self, v: torch.Tensor) -> torch.Tensor:
        return _stacked([torch.as_tensor(c @ x.numpy()) for c, x in zip(self.matrices, v, strict=True)])


def assembled(local: torch.Tensor, shapes: torch.Tensor, stiff: torch.Tensor,
              free: torch.Tensor) -> SparseStiffness | torch.Tensor:
    """The stiffness C of k patches: sparse on a CPU, and (k, 3 s, 3 s) [N/m] on a GPU, summed in a fixed order.

    Args:
        local, shapes: see `patch.nodal_sums`.
        stiff: stiffness of the contact points (k, 6 f, 3, 3) [N/m].
        free: 1 where a degree of freedom may move (k, 3 s).
    """
    own, width = stiff.view(*local.shape, 9), free.shape[1]
    touch, part = (own != 0.0).flatten(2).any(dim=2).nonzero(as_tuple=True)
    nodes, values = local[touch, part].long(), shapes[touch, part]
    pairs = (values[:, :, :, None] * values[:, :, None, :]).flatten(2).mT @ own[touch, part]  # (a, 36 pairs, 9)
    of = touch[:, None, None, None, None].expand(-1, 6, 6, 3, 3)
    row = (3 * nodes[:, :, None] + torch.arange(3, device=free.device)).view(-1, 6, 1, 3, 1).expand(-1, 6, 6, 3, 3)
    col = row.permute(0, 2, 1, 4, 3)
    pairs = pairs.view(-1, 6, 6, 3, 3) * free[of, row] * free[of, col]
    if free.device.type != "cpu":
        return free.new_zeros(len(local), width, width).index_put_((of, row, col), pairs, accumulate=True)
    out, ends = [], torch.searchsorted(touch, torch.arange(len(local) + 1)).tolist()
    for some in map(slice, ends, ends[1:]):
        out.append(sp.csr_matrix((pairs[some].flatten().numpy(), (row[some].flatten().numpy(),
                                  col[some].flatten().numpy())), shape=(width, width)))
        out[-1].eliminate_zeros()  # under a plane across an axis, two thirds
    return SparseStiffness(out)


@dataclass(frozen=True)
class ContactBlock:
    """The contact stiffness C of k touches, inverted together with the compliance A of the body.

    ``apply`` returns T v with T = (C^-1 + A)^-1 = C (1 + A C)^-1: the contact forces under displacements v of the
    patches, when the body responds as at rest. C need not be symmetric.
    """

    dof: torch.Tensor
    """Degrees of freedom that touch (k, m)."""
    stiffness: torch.Tensor
    """C there (k, m, m) [N/m]; on a GPU, where iterations apply it as a graph, T."""
    factors: tuple[torch.Tensor, torch.Tensor] | None
    """LU factors of 1 + A C (k, m, m) and their pivots (k, m); None with T."""
    width: int
    """Degrees of freedom of a patch, 3 s."""

    @classmethod
    def of(cls, stiffness: SparseStiffness | torch.Tensor, compliance: torch.Tensor, *,
           nodes: bool = False) -> ContactBlock:
        """From the stiffness and the compliance (k, 3 s, 3 s) [m/N] of k patches.

        ``nodes``: take all degrees of freedom of a node that touches. With friction those that touch change whenever a
        point begins to slip, and so would the rounding.
        """
        if isinstance(stiffness, torch.Tensor):
            dof = _used((stiffness != 0.0).any(dim=1), nodes)
            own, stiff = (_between(matrix, dof) for matrix in (compliance, stiffness))
            bracket = own @ stiff
            bracket.diagonal(dim1=1, dim2=2).add_(1.0)
            return cls(dof, stiff @ torch.linalg.inv_ex(bracket)[0], None, compliance.shape[2])
        used = torch.zeros(compliance.shape[:2], dtype=torch.bool)
        for b, c in enumerate(stiffness.matrices):
            used[b, torch.as_tensor(c.indices).long()] = True
        dof = _used(used, nodes)
        own, some, parts = _between(compliance, dof), [], []
        for c, a, at in zip(stiffness.matrices, own, dof.numpy(), strict=True):
            few = c[at][:, at]
            some.append(torch.as_tensor(few.toarray()))
            parts.append(torch.as_tensor(few.T @ a.numpy()).T)  # A C = (C^T A)^T: A is symmetric
        bracket = _stacked(parts)
        bracket.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(dof, _stacked(some), torch.linalg.lu_factor(bracket), compliance.shape[2])

    def pick(self, which: torch.Tensor) -> ContactBlock:
        """That of some of the touches (j,)."""
        factors = self.factors and (self.factors[0][which], self.factors[1][which])
        return ContactBlock(self.dof[which], self.stiffness[which], factors, self.width)

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        own = v.gather(1, self.dof)[:, :, None]
        if self.factors is not None:
            own = torch.linalg.lu_solve(*self.factors, own)
        force = (self.stiffness @ own)[:, :, 0]
        return torch.zeros_like(v).scatter_(1, self.dof, force)


def _entries(which: torch.Tensor) -> list[int]:
    return (which.nonzero()[:, 0] if which.dtype == torch.bool else which).tolist()


def _stacked(parts: list[torch.Tensor]) -> torch.Tensor:
    """As `torch.stack`, without a copy of a single one."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _used(touched: torch.Tensor, nodes: bool) -> torch.Tensor:
    """Indices (k, m) of the degrees of freedom that are ``touched`` (k, 3 s) bool, or of those of ``nodes`` that have
    any touched, padded to the largest number. Under a plane across an axis the first are a third of the second."""
    if nodes:
        touched = touched.view(len(touched), -1, 3).any(dim=2, keepdim=True).expand(-1, -1, 3).flatten(1)
    most = max(1, int(touched.sum(dim=1).amax()))
    return torch.sort(touched.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :most]


def _between(matrix: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
    """Rows and columns ``dof`` (k, m) of a matrix (k, 3 s, 3 s): (k, m, m)."""
    if len(matrix) == 1:
        return matrix[0].index_select(0, dof[0]).index_select(1, dof[0])[None]
    touch = torch.arange(len(matrix), device=matrix.device)[:, None, None]
    return matrix[touch, dof[:, :, None], dof[:, None, :]]
