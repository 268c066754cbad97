"""The stiffness of the points in contact, inverted together with the compliance of the body at rest."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class ContactBlock:
    """The contact stiffness C = R^T R of k touches and the compliance A of the body on the nodes that touch.

    ``apply`` gives T v with T = (C^-1 + A)^-1 = R^T (1 + R A R^T)^-1 R (Woodbury), for displacements v of the patches: the contact
    forces that answer v when the body gives way as at rest. If ``joined``, rows is C and inner (1 + A C)^-1: T = C (1 + A C)^-1.
    """

    dof: torch.Tensor
    rows: torch.Tensor
    inner: torch.Tensor
    width: int
    joined: bool = False

    @classmethod
    def of(cls, rows: torch.Tensor, compliance: torch.Tensor) -> ContactBlock:
        """From the rows R (k, m, 3 s) [sqrt(N/m)] and the compliance (k, 3 s, 3 s) [m/N] of the patches."""
        # of the patch only the nodes that touch count
        used = (rows != 0.0).any(dim=1).view(len(rows), -1, 3).any(dim=2)
        most = max(1, int(used.sum(dim=1).amax()))
        nodes = torch.sort(used.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :most]
        dof = (3 * nodes[:, :, None] + torch.arange(3, device=rows.device)).flatten(1)
        width = rows.shape[2]
        rows = rows.gather(2, dof[:, None, :].expand(-1, rows.shape[1], -1))
        own = compliance[torch.arange(len(rows), device=rows.device)[:, None, None], dof[:, :, None], dof[:, None, :]]
        if rows.shape[1] > rows.shape[2]:
            # more rows than degrees of freedom, as on the many Gauss points of linear faces: their product R^T R says the same
            stiff = rows.mT @ rows
            inner = own @ stiff
            inner.diagonal(dim1=1, dim2=2).add_(1.0)
            return cls(dof, stiff, torch.linalg.inv(inner), width, joined=True)
        inner = rows @ own @ rows.mT
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(dof, rows, torch.linalg.cholesky(inner), width)

    def pick(self, which: torch.Tensor) -> ContactBlock:
        """That of some of the touches (j,)."""
        return ContactBlock(self.dof[which], self.rows[which], self.inner[which], self.width, self.joined)

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        own = v.gather(1, self.dof)[:, :, None]
        if self.joined:
            force = self.rows @ (self.inner @ own)
        else:
            force = self.rows.mT @ torch.cholesky_solve(self.rows @ own, self.inner)
        return torch.zeros((len(v), self.width), dtype=v.dtype, device=v.device).scatter_(1, self.dof, force[:, :, 0])
