"""The inverse of a body's stiffness as a dense matrix on a GPU, and the response that it gives."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch
from filelock import FileLock

from vsfsim.physics.runtime import kernel_cache


def dense_inverse(matrix: sp.coo_matrix, free: np.ndarray, device: str) -> torch.Tensor:
    """The inverse (3 n, 3 n) [m/N] of a positive definite ``matrix`` (3 n, 3 n) [N/m], rows and columns 0 where a
    degree of freedom is not ``free`` (3 n,).

    The processes of a machine take turns: for a moment the matrix and its inverse are there, twice the memory that is
    kept.
    """
    with FileLock(kernel_cache() / f"{device.replace(':', '')}.lock"):
        left = torch.sparse_coo_tensor(np.stack([matrix.row, matrix.col]), matrix.data, matrix.shape, device=device,
                                       check_invariants=False).to_dense().mT
        torch.linalg.cholesky(left, out=left)  # in place: it is symmetric, and stored column after column
        out = torch.cholesky_inverse(left)
        del left
        torch.cuda.empty_cache()  # for the other processes
    mask = torch.as_tensor(free, device=device)
    return out.mul_(mask).mul_(mask[:, None])


def times(inverse: torch.Tensor, right: np.ndarray) -> np.ndarray:
    """The inverse (3 n, 3 n) [m/N] on a GPU times forces (3 n, k) [N] on the host."""
    out = inverse @ torch.as_tensor(right, dtype=inverse.dtype, device=inverse.device)
    return out.to(torch.float64).cpu().numpy()


class DenseResponse:
    """Products with the dense inverse (3 n, 3 n) [m/N] on a GPU; forces on patches multiply only the columns of all
    patches, whose degrees of freedom are ``dof`` (B, 3 s), -1 at padding."""

    took = 0.0
    resident = True

    def __init__(self, inverse: torch.Tensor, dof: torch.Tensor):
        self._inverse, self._dof = inverse, dof
        together = torch.unique(dof[dof >= 0])
        self._columns = inverse[:, together].contiguous()
        place = torch.zeros(len(inverse), dtype=torch.int64, device=dof.device)
        place[together] = torch.arange(len(together), device=dof.device)
        self._place = torch.where(dof >= 0, place[dof.clamp(min=0)], 0)

    def prepare(self, nodes: torch.Tensor) -> bool:
        """All of the inverse is there."""
        return False

    def compliance(self) -> torch.Tensor:
        """See `Response`."""
        mask, index = (self._dof >= 0).to(torch.float64), self._dof.clamp(min=0)
        table = self._inverse[index[:, :, None], index[:, None, :]].to(mask.dtype) * mask[:, :, None] * mask[:, None, :]
        return 0.5 * (table + table.mT)

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """See `Response`."""
        return (self._inverse @ right.to(self._inverse.dtype)).to(right.dtype)

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """See `Response`."""
        if not self._columns.shape[1]:  # no touch reaches anything
            return torch.zeros((len(self._inverse), len(touches)), dtype=force.dtype, device=force.device)
        pushed = self._columns.new_zeros((self._columns.shape[1], len(touches)))
        pushed.scatter_add_(0, self._place[touches].T, force.to(pushed.dtype).T)
        return (self._columns @ pushed).to(force.dtype)
