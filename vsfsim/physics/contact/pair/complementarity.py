"""Linear complementarity problems of a batch: find z >= 0 with y = G z + b >= 0 and z y = 0, G symmetric positive
definite.

It is the frictionless contact of a linear body: z the forces, y the gaps. Block principal pivoting (Kostreva 1978;
Judice and Pires 1994): all unknowns of the wrong sign change sides at once as long as their number falls, else for a
while, then only the last one (Murty), which ends.
"""

from __future__ import annotations

import torch

_PATIENCE = 10  # exchanges of all at once that may pass without a new least number of wrong signs
_SMALL = 1e-10  # of the largest |b| or z: rounding, not a wrong sign


def solve(matrix: torch.Tensor, offset: torch.Tensor, start: torch.Tensor, *, iterations: int = 200) -> torch.Tensor:
    """The solutions z (k, p).

    Args:
        matrix: G (k, p, p). offset: b (k, p). start: who is guessed to have z > 0 (k, p) bool. iterations: limit; what
        is left then keeps
            its last guess with the negative z set to 0.
    """
    inside = start.clone()
    count = offset.shape[1]
    z = torch.zeros_like(offset)
    best = torch.full((len(offset),), count + 1, dtype=torch.int64, device=offset.device)
    patience = torch.full_like(best, _PATIENCE)
    last = torch.arange(count, device=offset.device)
    eye = torch.eye(count, dtype=offset.dtype, device=offset.device)
    for _ in range(iterations):
        both = inside[:, :, None] & inside[:, None, :]
        held = torch.where(both, matrix, torch.where(inside[:, :, None], 0.0, eye))
        z = torch.cholesky_solve(torch.where(inside, -offset, 0.0)[:, :, None], torch.linalg.cholesky(held))[:, :, 0]
        y = (matrix @ z[:, :, None])[:, :, 0] + offset
        wrong = torch.where(inside, z < -_SMALL * z.abs().amax(dim=1, keepdim=True),
                            y < -_SMALL * offset.abs().amax(dim=1, keepdim=True))
        left = wrong.sum(dim=1)
        if not bool(left.any()):
            break
        fewer = left < best
        best = torch.where(fewer, left, best)
        patience = torch.where(fewer, _PATIENCE, patience - 1)
        single = torch.where(wrong, last, -1).amax(dim=1)
        one = (last == single[:, None]) & wrong
        inside = inside ^ torch.where((patience >= 0)[:, None], wrong, one)
    return z.clamp(min=0.0)
