"""The stiffness of contact points on the nodes of the patches, alone and in series with a compliance.

Points come in *parts*, whose q points act on the same n nodes: six Gauss points on the six nodes of a face, or one node
and its place on a face of another surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from vsfsim.physics.contact.patch import added

_SIZES = 64  # the numbers of connected degrees of freedom on a GPU are multiples of it


@dataclass(frozen=True)
class ContactStiffness:
    """The stiffness C of k patches as an operator, ``stiffness @ v`` for v (k, 3 s, 1). It need not be symmetric."""

    dof: torch.Tensor
    """Degrees of freedom of the patches that it connects (k, m); the first again is padding."""
    matrix: torch.Tensor
    """C between them (k, m, m) [N/m]; on a GPU in series with a compliance all of the operator."""
    factors: tuple[torch.Tensor, ...] = ()
    """LU factors (k, m, m) of 1 + A C and pivots (k, m), in series with a compliance A on a CPU."""

    def __getitem__(self, which: torch.Tensor) -> ContactStiffness:
        return ContactStiffness(self.dof[which], self.matrix[which], tuple(t[which] for t in self.factors))

    def __matmul__(self, v: torch.Tensor) -> torch.Tensor:
        dof = self.dof[:, :, None]
        own = v.gather(1, dof)
        own = torch.linalg.lu_solve(*self.factors, own) if self.factors else own
        return torch.zeros_like(v).scatter_add_(1, dof, self.matrix @ own)

    def in_series(self, compliance: torch.Tensor) -> ContactStiffness:
        """T = (C^-1 + A)^-1 = C (1 + A C)^-1 with a symmetric compliance A (k, m, m) [m/N] between `dof`: the contact
        forces under displacements of the patches when the body responds with A."""
        c, on_cpu = self.matrix, self.matrix.is_cpu  # there a sparse product and LU factors save time
        bracket = torch.bmm(c.mT.to_sparse(), compliance).mT if on_cpu else compliance @ c
        bracket.diagonal(dim1=1, dim2=2).add_(1.0)
        if on_cpu:
            return replace(self, factors=torch.linalg.lu_factor_ex(bracket)[:2])
        return replace(self, matrix=torch.linalg.solve_ex(bracket, c, left=False)[0])


def assembled(local: torch.Tensor, shapes: torch.Tensor, stiff: torch.Tensor, free: torch.Tensor, *,
              whole: bool, turn: tuple[int, torch.Tensor] | None = None) -> list[ContactStiffness]:
    """Some stiffnesses of k patches, summed in a fixed order.

    Args:
        local: nodes of the parts (k, f, n).
        shapes: shape values of their points (k, f, q, n).
        stiff: stiffnesses of the points (k, f q, v, 3, 3) [N/m].
        free: 1 where a degree of freedom may move (k, 3 s).
        whole: take all degrees of freedom of a node that touches. With friction those that touch change whenever a
            point begins to slip, and so would the rounding; else they are a third of them under a plane across an axis.
        turn: a node from which on displacements are in a frame of its own, and the rotations of that frame (k, 3, 3).

    Returns:
        The v stiffnesses, all between the same degrees of freedom.
    """
    own, n = stiff.unflatten(1, shapes.shape[1:3]).flatten(3), local.shape[2]
    touch, part = (own != 0.0).flatten(2).any(dim=2).nonzero(as_tuple=True)
    nodes, values = local[touch, part].long(), shapes[touch, part]
    pairs = (values[:, :, :, None] * values[:, :, None, :]).flatten(2).mT @ own[touch, part]
    pairs = pairs.view(-1, n, n, *stiff.shape[2:])
    if turn is not None:
        frame = torch.where((nodes < turn[0])[:, :, None, None], torch.eye(3).to(free), turn[1][touch][:, None])
        pairs = frame.mT[:, :, None, None] @ pairs @ frame[:, None, :, None]
    dofs = 3 * nodes[:, :, None] + torch.arange(3, device=free.device)  # (a, n, 3)
    moves = free[touch[:, None, None], dofs]
    pairs = pairs * moves[:, :, None, None, :, None] * moves[:, None, :, None, None, :]
    a, i, j, x, y = (pairs != 0.0).any(dim=3).nonzero(as_tuple=True)
    of, row, col, pairs = touch[a], dofs[a, i, x], dofs[a, j, y], pairs[a, i, j, :, x, y]
    used = torch.zeros(free.shape, dtype=torch.bool, device=free.device)
    used[of, row] = used[of, col] = True
    if whole:
        used = used.view(len(used), -1, 3).any(dim=2, keepdim=True).expand(-1, -1, 3).flatten(1)
    count, place = used.sum(dim=1, keepdim=True), used.cumsum(dim=1) - 1
    k, m = len(free), max(1, int(count.amax()))
    if not free.is_cpu:  # few sizes, so that a graph serves again
        m = min(-(-m // _SIZES) * _SIZES, free.shape[1])
    dof = torch.sort(used.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :m]
    dof = torch.where(torch.arange(m, device=free.device) < count, dof, dof[:, :1])
    at = of, place[of, row], place[of, col]
    return [ContactStiffness(dof, added(free.new_zeros(k, m, m), at, pair)) for pair in pairs.unbind(dim=1)]
