"""The inverse of a body's stiffness as a dense matrix on a GPU."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import torch

from vsfsim.core.system.file_lock import lock
from vsfsim.physics.runtime import kernel_cache


def dense_inverse(matrix: sp.coo_matrix, free: np.ndarray, device: str) -> torch.Tensor:
    """The inverse (3 n, 3 n) [m/N] of a positive definite ``matrix`` (3 n, 3 n) [N/m], rows and columns 0 where a
    degree of freedom is not ``free`` (3 n,).

    The processes of a machine take turns: for a moment the matrix and its inverse are there, twice the memory that is
    kept.
    """
    with open(kernel_cache() / f"{device.replace(':', '')}.lock", "w") as file:
        lock(file.fileno(), wait=True)
        left = torch.sparse_coo_tensor(np.stack([matrix.row, matrix.col]), matrix.data, matrix.shape, device=device,
                                       check_invariants=False).to_dense().mT
        torch.linalg.cholesky(left, out=left)  # in place: it is symmetric, and stored column after column
        out = torch.cholesky_inverse(left)
        del left
        torch.cuda.empty_cache()  # for the other processes
    mask = torch.as_tensor(free, device=device)
    return out.mul_(mask).mul_(mask[:, None])
