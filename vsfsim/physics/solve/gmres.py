"""Generalised minimal residuals for several touches at once (Saad and Schultz 1986), preconditioned from the right: for
contact between two deformable surfaces, whose tangent is not symmetric.

    min |b - A M^-1 y|  over the Krylov space of A M^-1,   x = M^-1 y
"""

from __future__ import annotations

import torch

from vsfsim.physics import clock
from vsfsim.physics.solve.pcg import Operator, column_dots


def solve(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor, iterations: int,
          deadline: float = float("inf")) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve A x = ``right`` from x = 0; arguments as `pcg.solve`, the residual measured by its length.

    Returns:
        x (3 n, k) and iterations of each column (k,).
    """
    size = column_dots(right, right).sqrt().clamp(min=1e-300)
    basis, searched = [right / size], []
    k = right.shape[1]
    upper = torch.zeros((k, iterations + 1, iterations), dtype=torch.float64, device=right.device)
    steps = torch.zeros(k, dtype=torch.int64, device=right.device)
    running = torch.ones(k, dtype=torch.bool, device=right.device)
    y = None
    for j in range(iterations):
        if j and clock.now() > deadline:
            break
        steps += running
        searched.append(precondition(basis[j], None))
        w = multiply(searched[j], None)
        for _ in range(2):  # twice is enough (Kahan)
            for i, v in enumerate(basis):
                h = column_dots(v, w)
                upper[:, i, j] += h
                w = w - h * v
        length = column_dots(w, w).sqrt()
        upper[:, j + 1, j] = length
        basis.append(w / length.clamp(min=1e-300))
        own = upper[:, :j + 2, :j + 1]
        goal = torch.zeros((k, j + 2, 1), dtype=torch.float64, device=right.device)
        goal[:, 0, 0] = size
        q, r = torch.linalg.qr(own)
        new = torch.linalg.solve_triangular(r, q.mT @ goal, upper=True)
        left = (own @ new - goal)[:, :, 0].norm(dim=1)
        grown = torch.zeros((k, j + 1, 1), dtype=torch.float64, device=right.device)
        if y is not None:
            grown[:, :j] = y
        y = torch.where(running[:, None, None], new, grown)
        running = running & (left > tolerance * size)
        if not bool(running.any()):
            break
    out = torch.zeros_like(right)
    for i, z in enumerate(searched[:y.shape[1]]):
        out += z * y[:, i, 0]
    return out, steps
