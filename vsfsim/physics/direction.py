"""One Newton direction for a batch of touches: elements and contact in the matrix, both answered by the preconditioner."""

from __future__ import annotations

import torch
import warp as wp

from vsfsim.physics import clock, pcg
from vsfsim.physics.elasticity import Elasticity
from vsfsim.physics.factor import spread
from vsfsim.physics.touching import Touching


def newton_direction(elasticity: Elasticity, touching: Touching, columns: torch.Tensor, residual: torch.Tensor, *, near: torch.Tensor,
                     tolerance: torch.Tensor, iterations: int) -> tuple[torch.Tensor, int, torch.Tensor, torch.Tensor]:
    """Solve (tangent + contact) d = residual by `pcg`.

    Args:
        elasticity: with the tangent of ``columns`` made. touching: evaluated at the present state.
        columns: touches (k,). residual: unbalanced forces (3 n, k) [N].
        near: whose contact counts with its geometric term (k,) bool; deep inside a body that term is large, and wrong.
        tolerance: relative residual of each column (k,). iterations: limit.

    Returns:
        Directions (3 n, k) [m]; iterations; who met negative curvature (k,) bool; the contact stiffness used (k, 3 s, 3 s) [N/m].
    """
    index = wp.from_torch(columns.to(torch.int32))
    response = touching.response
    stiffness = touching.stiffness(columns, near)
    has_contact = bool(touching.touches(columns).any())
    block = touching.block(columns) if has_contact else None
    dof, real = touching.dof[columns], touching.real[columns]
    at = dof.clamp(min=0).T
    size = len(residual)

    def on_patch(x: torch.Tensor) -> torch.Tensor:
        return x.gather(0, at).T.to(torch.float64) * real

    def multiply(x: torch.Tensor) -> torch.Tensor:
        with clock.measure("products"):
            out = wp.to_torch(elasticity.multiply(index, wp.from_torch(x.contiguous())))
        if block is not None:
            out = out + spread(dof, (stiffness @ on_patch(x)[:, :, None])[:, :, 0], size).to(out.dtype)
        return out

    def precondition(r: torch.Tensor) -> torch.Tensor:
        with clock.measure("back-solves"):
            y = response.solve(r.to(torch.float64))
            if block is not None:
                y = y - response.patch(columns, block.apply(on_patch(y)))
        return y.to(r.dtype)

    direction, steps, negative = pcg.solve(multiply, precondition, residual, tolerance=tolerance, iterations=iterations)
    return direction, steps, negative, stiffness
