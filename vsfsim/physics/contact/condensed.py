"""The condensed contact problem: the body responds to contact as it would at rest, and only the patches are unknown.

On a patch's degrees of freedom the rest-state compliance A gives the elastic response of the whole body,

    u_S = u0_S + A q,     q = f(u_S) - f0,

with the compliance of springs that carry the bodies in series with A. A semi-smooth Newton method solves it for all
touches at once. It is the `linear` tier, and the prediction of the others. Near the solution the contact of many points
has its geometric term, without which the method converges linearly near a body's edges; where that does not help, it is
left out again. Directions are in single precision there.

A point that slips has no stiffness along the slip. A step then throws it past its anchor, where it should stick. With
friction each point therefore also has the force that the step before expected of it, and whether it sticks is told by
that force and a little of its way (`friction.linearised`; Alart and Curnier 1991): the law in its mixed form, with the
same solution.
"""

from __future__ import annotations

from typing import Any

import torch

from vsfsim.physics import clock

_RELIEF = 0.01  # of the stick stiffness: about the stiffness of the body itself at a contact point
_CURVED, _AGAIN = 0.01, 0.1  # error from which on the stiffness has its geometric term; part of it after a failure
_PATIENCE = 8  # iterations without a new least error after which a problem is given up: its body slides about an edge
_ROUNDING = 1e-12  # of the energy: rounding of the sum over the patch
_COMPACT = 0.8  # share of running touches under which the others are dropped from the tensors


def solve(contact: Any, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float | torch.Tensor, start: torch.Tensor | None = None,
          deadline: float = float("inf")) -> tuple[torch.Tensor, torch.Tensor]:
    """Change of the contact forces when the bodies are where `Contact.move` put them.

    Args:
        contact: the contact with rigid bodies.
        columns: touches (k,).
        base: displacements of their patches before (k, 3 s) [m].
        pushed: contact forces before (k, 3 s) [N].
        iterations: limit of Newton's method.
        tolerance: relative error of the displacements of the patch, of all touches or of each (k,).
        start: first guess of the changes (k, 3 s) [N]; None is zero.
        deadline: `clock.now` after which no iteration but the first begins [s].

    Returns:
        Changes (k, 3 s) [N] and the relative errors left (k,).
    """
    compliance, held = contact.compliance[columns], None
    q = torch.zeros_like(base) if start is None else start.clone()
    trial, best = base + _times(compliance, q), q.clone()
    error = torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    most, tolerance = torch.full_like(error, _CURVED), torch.as_tensor(tolerance, device=base.device).expand_as(error)
    idle, curved = torch.zeros_like(columns), torch.zeros_like(columns, dtype=torch.bool)
    low, lowest = torch.full_like(error, float("inf")), [q, trial]  # least energy, and where it was found
    live, found, left = torch.arange(len(columns), device=base.device), best.clone(), error.clone()
    for step in range(iterations + 1):
        contact.evaluate(columns, trial, pushed + q)
        rho = contact.nodal(columns) - pushed - q
        miss = _times(compliance, rho) + contact.given(columns, rho)
        size = miss.abs().amax(dim=1) / trial.abs().amax(dim=1).clamp(min=1e-9)
        better = size < error
        best, error = torch.where(better[:, None], q, best), torch.where(better, size, error)
        most = torch.where(curved & ~better, _AGAIN * error, most)
        rises = torch.zeros_like(better)
        if not contact.has_friction:  # there is an energy: where it rises, half of the way back to where it was least
            energy = ((0.5 * q + pushed) * (trial - base)).sum(dim=1)
            energy += contact.energy(columns) + contact.carried(columns)
            rises = energy > low + _ROUNDING * low.abs()
            low = torch.where(rises, low, energy)
            lowest = [torch.where(rises[:, None], a, b) for a, b in zip(lowest, (q, trial), strict=True)]
        idle = torch.where(better, 0, idle + ~rises)
        running = (error >= tolerance) & (idle < _PATIENCE)
        count = int(running.sum())
        if step == iterations or not count or (step and clock.now() > deadline):
            break
        if count < _COMPACT * len(live):
            found[live], left[live] = best, error
            keep = running.nonzero()[:, 0]
            live, columns, compliance, base, pushed, q, trial, rho, miss = (
                x[keep] for x in (live, columns, compliance, base, pushed, q, trial, rho, miss))
            best, error, size, most, idle, tolerance, low, rises = (
                x[keep] for x in (best, error, size, most, idle, tolerance, low, rises))
            lowest = [x[keep] for x in lowest]
            held, running = None if held is None else held[keep], running[keep]
        curved = size < most
        if contact.has_friction:
            if held is not None:
                contact.held[columns] = held
            contact.relief[columns] = _RELIEF
            contact.evaluate(columns, trial, pushed + q)
            contact.relief[columns] = 1.0
            rho = contact.nodal(columns) - pushed - q
            miss = _times(compliance, rho) + contact.given(columns, rho)
        dq = rho - contact.block(columns, torch.float32, curved).apply(miss)
        move = _times(compliance, dq)
        if contact.has_friction:
            held = contact.expected(columns, move + contact.given(columns, dq))
        back = [0.5 * (a - b) for a, b in zip(lowest, (q, trial), strict=True)]
        q, trial = (torch.where(running[:, None], x + torch.where(rises[:, None], half, way), x)
                    for x, half, way in zip((q, trial), back, (dq, move), strict=True))
    found[live], left[live] = best, error
    return found, left


def _times(compliance: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    return (compliance @ q[:, :, None])[:, :, 0]
