"""Conjugate gradients for several touches at once, vectors (3 n, k), one column a touch.

The matrix is the object's tangent plus the contact block of each touch; the preconditioner is the rest-state inverse
with the contact block added exactly (Woodbury):

    (K0 + S C S^T)^-1 = K0^-1 (1 - S T S^T K0^-1),   T = (C^-1 + A)^-1,   A = S^T K0^-1 S

with S the patch's degrees of freedom and A its compliance. Columns stop together; one that has converged takes zero
steps.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from vsfsim.physics import clock

Operator = Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]
_COMPACT = 0.7  # share of running columns under which the others are dropped from the tensors


def column_dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Dot product of every column (k,)."""
    return (a * b).sum(dim=0)


def solve(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor,
          iterations: int, plain: bool = False, deadline: float = float("inf"),
          ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve A x = ``right`` from x = 0.

    Args:
        multiply, precondition: A p and M^-1 r on tensors (3 n, j); their second argument names the columns of ``right``
            (j,), or is None for all.
        right: right-hand sides (3 n, k).
        tolerance: relative residual of each column (k,).
        iterations: limit.
        plain: measure the residual by its length, which saves the last use of the preconditioner, instead of in the
            preconditioner's norm.
        deadline: `clock.now` after which no iteration begins and the preconditioner is not used again [s]; x is
            then what was reached, a direction of descent all the same.

    Returns:
        x (3 n, k), iterations of each column (k,), and which met negative curvature (k,) bool: such a column keeps its
        last x, or the first direction.
    """
    which: torch.Tensor | None = None
    out = torch.zeros_like(right)
    x = out
    r = right.clone()
    z = precondition(r, None)
    p = z.clone()
    rz = column_dots(r, z)
    start = (column_dots(r, r) if plain else rz).clamp(min=1e-300)
    running = rz > 0.0
    curved = torch.zeros_like(rz, dtype=torch.bool)
    steps = torch.zeros(right.shape[1], dtype=torch.int64, device=right.device)
    for step in range(iterations):
        if step and clock.now() > deadline:
            break
        ap = multiply(p, which)
        pap = column_dots(p, ap)
        bad = running & ~(pap > 0.0)
        curved[slice(None) if which is None else which] |= bad
        steps[slice(None) if which is None else which] += running
        if step == 0:
            x += p * bad
        running = running & ~bad
        alpha = torch.where(running, rz / torch.where(pap > 0.0, pap, 1.0), 0.0)
        x += alpha * p
        r -= alpha * ap
        if plain:
            goes_on = running & (column_dots(r, r) > tolerance**2 * start)
            left = int(goes_on.sum())
            if left == 0 or step == iterations - 1:
                break
        if clock.now() > deadline:
            break
        z = precondition(r, which)
        fresh = column_dots(r, z)
        if not plain:
            goes_on = running & (fresh > tolerance**2 * start)
            left = int(goes_on.sum())
            if left == 0:
                break
        beta = torch.where(goes_on, fresh / torch.where(rz > 0.0, rz, 1.0), 0.0)
        p = z + beta * p
        rz = torch.where(running, fresh, rz)
        running = goes_on
        if left < _COMPACT * len(running):
            if which is not None:
                out[:, which] = x
            keep = running.nonzero()[:, 0]
            which = keep if which is None else which[keep]
            x, r, p = x[:, keep], r[:, keep], p[:, keep]
            rz, start, tolerance = rz[keep], start[keep], tolerance[keep]
            running = torch.ones_like(keep, dtype=torch.bool)
    if which is not None:
        out[:, which] = x
    return out, steps, curved
