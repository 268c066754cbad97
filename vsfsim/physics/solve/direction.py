"""One Newton direction for a batch of touches: elements and contact are in the matrix and in the preconditioner."""

from __future__ import annotations

import torch
import warp as wp

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.solve import gmres, pcg
from vsfsim.physics.solve.elasticity import Elasticity


def newton_direction(elasticity: Elasticity, contact: Contact, columns: torch.Tensor, residual: torch.Tensor, *,
                     near: torch.Tensor, tolerance: torch.Tensor, iterations: int,
                     plain: bool = False, deadline: float = float("inf"), shift: torch.Tensor | None = None,
                     ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve (tangent + contact) d = residual by `pcg`, or by `gmres` where the contact is not symmetric.

    Args:
        elasticity: elements, with the tangent of ``columns`` computed.
        contact: contact, evaluated at the present state.
        columns: touches (k,).
        residual: unbalanced forces (3 n, k) [N].
        near: whose contact stiffness has its geometric term (k,) bool, see `Contact.stiffness`.
        tolerance: relative residual of each column (k,).
        iterations: limit.
        plain, deadline, shift: see `pcg.solve`.

    Returns:
        Directions (3 n, k) [m]; iterations of each (k,); the negative curvature that each met (k,) [-], 0 for none and
        with `gmres`; the contact stiffness used (k, 3 s, 3 s) [N/m].
    """
    response = contact.response
    stiffness = contact.stiffness(columns, near)
    block = contact.block(columns) if bool(contact.touches(columns).any()) else None
    size = len(residual)

    class Part:
        """What the products need of the columns ``which``."""

        def __init__(self, which: torch.Tensor | None):
            own = columns if which is None else columns[which]
            self.columns, self.index = own, wp.from_torch(own.to(torch.int32))
            self.dof, self.mask = contact.dof[own], contact.mask[own]
            self.at = self.dof.clamp(min=0).T
            if block is not None:
                self.stiffness = stiffness if which is None else stiffness[which]
                self.block = block if which is None else block.pick(which)

        def patch(self, x: torch.Tensor) -> torch.Tensor:
            return x.gather(0, self.at).T.to(torch.float64) * self.mask

    parts: dict[int, Part] = {}

    def part(which: torch.Tensor | None) -> Part:
        key = len(columns) if which is None else len(which)  # the columns that are left only get fewer
        if key not in parts:
            parts[key] = Part(which)
        return parts[key]

    def multiply(x: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        with clock.measure("products"):
            out = wp.to_torch(elasticity.multiply(own.index, wp.from_torch(x.contiguous())))
        if block is not None:
            out = out + spread(own.dof, (own.stiffness @ own.patch(x)[:, :, None])[:, :, 0], size).to(out.dtype)
        return out

    def precondition(r: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        with clock.measure("back-solves"):
            y = response.solve(r.to(torch.float64))
            if block is not None:
                y = y - response.patch(own.columns, own.block.apply(own.patch(y)))
        return y.to(r.dtype)

    if not contact.symmetric:
        direction, steps = gmres.solve(multiply, precondition, residual, tolerance=tolerance, iterations=iterations,
                                       deadline=deadline)
        return direction, steps, torch.zeros_like(tolerance), stiffness
    direction, steps, negative = pcg.solve(multiply, precondition, residual, tolerance=tolerance, iterations=iterations,
                                           plain=plain, deadline=deadline, shift=shift)
    return direction, steps, negative, stiffness
