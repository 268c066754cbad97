"""One Newton direction for a batch of touches: elements and contact are in the matrix and in the preconditioner."""

from __future__ import annotations

import torch
import warp as wp

from vsfsim.physics.contact.points import Contact
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.krylov import conjugate_gradients, gmres
from vsfsim.physics.solve.tangent_factor import TangentFactors


def newton_direction(elasticity: Elasticity, contact: Contact, columns: torch.Tensor, residual: torch.Tensor, *,
                     near: torch.Tensor, tolerance: torch.Tensor, iterations: int,
                     deadline: float = float("inf"), factors: TangentFactors | None = None,
                     ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve (tangent + contact) d = residual by conjugate gradients, or by `gmres` where the contact is not symmetric.

    Args:
        elasticity: elements, with the tangent of ``columns`` computed.
        contact: contact, evaluated at the present state.
        columns: touches (k,).
        residual: unbalanced forces (3 n, k) [N].
        near: whose contact stiffness has its geometric term (k,) bool, see `Contact.stiffness`.
        tolerance: relative residual of each column (k,).
        iterations: limit.
        deadline: see `krylov`.
        factors: of deformed states, which precondition the touches that have one; they note the iterations.

    Returns:
        Directions (3 n, k) [m]; iterations of each (k,); and which met negative curvature (k,) bool, none with
        `gmres`.
    """
    response = contact.response
    stiffness = contact.stiffness(columns, near)
    own_factor = [None if factors is None else factors.of(b) for b in columns.tolist()]
    touched = bool(contact.touches(columns).any())
    # a factor of a deformed state has the contact in it; the one at rest is corrected for it
    block = contact.block(columns) if touched and None in own_factor else None

    class Part:
        """What the products need of the columns ``which``."""

        def __init__(self, which: torch.Tensor | None):
            own = columns if which is None else columns[which]
            picked = range(len(own)) if which is None else which.tolist()
            self.columns, self.index = own, wp.from_torch(own.to(torch.int32))
            self.at = contact.dof[own].clamp(min=0).T
            self.factors = [(j, own_factor[k]) for j, k in enumerate(picked) if own_factor[k] is not None]
            self.resting = contact.mask.new_tensor([[1.0 * (own_factor[k] is None)] for k in picked])
            if touched:
                self.stiffness = stiffness if which is None else stiffness[which]
            if block is not None:
                self.block = block if which is None else block[which]

    parts: dict[int, Part] = {}

    def part(which: torch.Tensor | None) -> Part:
        key = len(columns) if which is None else len(which)  # the columns that are left only get fewer
        if key not in parts:
            parts[key] = Part(which)
        return parts[key]

    def multiply(x: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        out = torch.empty_like(x)
        elasticity.multiply(own.index, wp.from_torch(x), wp.from_torch(out))
        if touched:
            out.scatter_add_(0, own.at, (own.stiffness @ contact.gather(x, own.columns)[:, :, None])[:, :, 0].T)
        return out

    def precondition(r: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        y = torch.empty_like(r) if len(own.factors) == r.shape[1] else response.solve(r)
        if block is not None:
            force = (own.block @ contact.gather(y, own.columns)[:, :, None])[:, :, 0]
            y = y - response.patch(own.columns, own.resting * force)
        for j, factor in own.factors:
            y[:, j:j + 1] = torch.as_tensor(factor.solve(r[:, j:j + 1].numpy()))
        return y

    if not contact.symmetric:
        direction, steps = gmres(multiply, precondition, residual, tolerance=tolerance, iterations=iterations,
                                       deadline=deadline)
        return direction, steps, torch.zeros_like(tolerance, dtype=torch.bool)
    direction, steps, curved = conjugate_gradients(
        multiply, precondition, residual, tolerance=tolerance, iterations=iterations, deadline=deadline,
        resident=response.resident)
    if factors is not None:
        factors.count(columns, steps)
    return direction, steps, curved
