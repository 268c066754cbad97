"""Conjugate gradients for several touches at once, vectors (3 n, k), one column a touch.

The matrix is the object's tangent plus the contact block of each touch; the preconditioner is the rest-state inverse with the contact block
added exactly (Woodbury):

    (K0 + S C S^T)^-1 = K0^-1 (1 - S T S^T K0^-1),   T = (C^-1 + A)^-1,   A = S^T K0^-1 S

with S the patch's degrees of freedom and A its compliance. Columns stop together; one that is done is frozen by a zero step.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

Operator = Callable[[torch.Tensor], torch.Tensor]


def column_dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Dot product of every column (k,), summed in double."""
    return (a.to(torch.float64) * b.to(torch.float64)).sum(dim=0)


def solve(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor,
          iterations: int) -> tuple[torch.Tensor, int, torch.Tensor]:
    """Solve A x = ``right`` from x = 0.

    Args:
        multiply, precondition: A p and M^-1 r, on (3 n, k) tensors.
        right: (3 n, k). tolerance: relative residual in the preconditioner's norm, per column (k,). iterations: the limit.

    Returns:
        x (3 n, k), iterations done, and which columns met negative curvature (k,) bool: those keep what they have so far
        (their first direction at the least).
    """
    x = torch.zeros_like(right)
    r = right.clone()
    z = precondition(r)
    p = z.clone()
    rz = column_dots(r, z)
    start = rz.clamp(min=1e-300)
    running = rz > 0.0
    negative = torch.zeros_like(running)
    done = 0
    for step in range(iterations):
        ap = multiply(p)
        pap = column_dots(p, ap)
        bad = running & ~(pap > 0.0)
        negative = negative | bad
        if step == 0:
            x = x + p * bad
        running = running & ~bad
        alpha = torch.where(running, rz / torch.where(pap > 0.0, pap, 1.0), 0.0).to(right.dtype)
        x += alpha * p
        r -= alpha * ap
        z = precondition(r)
        fresh = column_dots(r, z)
        done = step + 1
        goes_on = running & (fresh > tolerance**2 * start)
        if not bool(goes_on.any()):
            break
        beta = torch.where(goes_on, fresh / torch.where(rz > 0.0, rz, 1.0), 0.0).to(right.dtype)
        p = z + beta * p
        rz = torch.where(running, fresh, rz)
        running = goes_on
    return x, done, negative
