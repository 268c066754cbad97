"""The condensed contact problem: the body responds to contact as it would at rest, and only the patches are unknown.

On a patch's degrees of freedom the rest-state compliance A gives the elastic response of the whole body,

    u_S = u0_S + A q,     q = f(u_S) - f0,

which is the stationary point of 1/2 q^T A q + f0 . A q + (energy of the contact, and of springs that carry the bodies,
whose compliance is in series with A); a semi-smooth Newton method with a
line search on that energy solves it for all touches at once. It is the `linear` tier.
Near the solution the contact has its geometric term, without which the method converges linearly near a
body's edges; where that leads up, it is left out again. Directions are in single precision there.
"""

from __future__ import annotations

from typing import Any

import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.contact.line_search import AGAIN, CURVED, LineSearch

_FIRST_TOLERANCE = 1e-3  # of the contact without friction, which only leads the way
_RELIEF = 0.01  # of the stick stiffness: about the stiffness of the body itself at a contact point
_COMPACT = 0.8  # share of running touches under which the others are dropped from the tensors


def solve(contact: Any, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float, start: torch.Tensor | None = None,
          deadline: float = float("inf")) -> tuple[torch.Tensor, torch.Tensor]:
    """Change of the contact forces when the bodies are where `Contact.move` put them.

    Args:
        contact: the contact with rigid bodies.
        columns: touches (k,).
        base: displacements of their patches before (k, 3 s) [m].
        pushed: contact forces before (k, 3 s) [N].
        iterations: limit of Newton's method.
        tolerance: relative error of the displacements of the patch.
        start: first guess of the changes (k, 3 s) [N]; None is zero.
        deadline: `clock.now` after which no iteration but the first begins [s].

    Returns:
        Changes (k, 3 s) [N] and the relative errors left (k,).
    """
    if not (contact.has_friction and contact.solid):
        return _newton(contact, columns, base, pushed, start, iterations, tolerance, deadline)
    best_change, error = _mixed(contact, columns, base, pushed, start, iterations, tolerance, deadline)
    again = (error > tolerance).nonzero()[:, 0]
    if len(again) and clock.now() < deadline:
        # begin from the contact without friction
        some, limit = columns[again], contact.limit[columns[again]]
        contact.limit[some] = 0.0
        part, _ = _newton(contact, some, base[again], pushed[again], None, iterations, _FIRST_TOLERANCE, deadline)
        contact.limit[some] = limit
        part, new = _mixed(contact, some, base[again], pushed[again], part, iterations, tolerance, deadline)
        better = new < error[again]
        best_change[again[better]], error[again[better]] = part[better], new[better]
    return best_change, error


def _newton(contact: Contact, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor,
            start: torch.Tensor | None, iterations: int, tolerance: float,
            deadline: float) -> tuple[torch.Tensor, torch.Tensor]:
    compliance, yielding = contact.compliance[columns], contact.yielding[columns]
    q = torch.zeros_like(base) if start is None else start.clone()
    trial = base + _times(compliance, q) if start is not None else base.clone()
    best, best_error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    live = None  # indices of the touches in the tensors, None for all; many are dropped at once, since indexing costs
    dq, move, best_change = torch.zeros_like(q), torch.zeros_like(q), best.clone()
    search = LineSearch(len(columns), tolerance, iterations, base.device)
    for step_number in range(iterations):
        if step_number and clock.now() > deadline:
            break
        contact.evaluate(columns, trial, pushed + q)
        energy = ((0.5 * q + pushed) * (trial - base)).sum(dim=1) + contact.energy(columns) + contact.carried(columns)
        change = contact.nodal(columns) - pushed
        rho = change - q
        miss = _times(yielding, rho)
        size = miss.abs().amax(dim=1) / trial.abs().amax(dim=1).clamp(min=1e-9)
        left, going = search.judge(energy, contact.wrong_side(columns), size)
        best_change = torch.where(search.better[:, None], change, best_change)
        if left == 0:
            break
        if going:
            new, curved, up = _direction(contact, columns, rho, miss, search.bends)
            search.turn((new * miss).sum(dim=1), curved, up)
            dq = torch.where(search.ahead[:, None], new, dq)
            move = torch.where(search.ahead[:, None], _times(compliance, new), move)
        go = search.go[:, None]
        q, trial = q + go * dq, trial + go * move
        if left < _COMPACT * len(columns):
            where = slice(None) if live is None else live
            best[where], best_error[where] = best_change, search.error
            keep = search.keep()
            live = keep if live is None else live[keep]
            columns, compliance, yielding, base, pushed, q, trial, dq, move, best_change = (
                x[keep] for x in (columns, compliance, yielding, base, pushed, q, trial, dq, move, best_change))
    where = slice(None) if live is None else live
    best[where], best_error[where] = best_change, search.error
    return best, best_error


def _direction(contact: Any, columns: torch.Tensor, rho: torch.Tensor, miss: torch.Tensor,
               curved: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Newton's direction (k, 3 s) [N], with the geometric term of the contact for touches that are ``curved`` (k,);
    which of these have it (k,), and for which it was left out again because it led up (k,)."""
    new = rho - contact.block(columns, torch.float32, curved).apply(miss)
    up = curved & ((new * miss).sum(dim=1) <= 0.0)
    if bool(up.any()):
        new[up] = rho[up] - contact.block(columns[up], torch.float32).apply(miss[up])
    return new, curved & ~up, up


def _mixed(contact: Any, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, start: torch.Tensor | None,
           iterations: int, tolerance: float, deadline: float) -> tuple[torch.Tensor, torch.Tensor]:
    """As `_newton`, for touches of a solid with friction: Newton's method on the law in its mixed form.

    A point that slips has no stiffness along the slip. A step then throws it past its anchor, where it should stick,
    and a line search on the energy goes on by small parts of steps. Here each point also has the force that the step
    before expected of it, and whether it sticks is told by that force and a little of its way (`friction.linearised`;
    Alart and Curnier 1991). The solution is the same.
    """
    compliance, yielding = contact.compliance[columns], contact.yielding[columns]
    q = torch.zeros_like(base) if start is None else start.clone()
    trial = base + _times(compliance, q)
    best, error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    held = None
    most, curved = torch.full_like(error, CURVED), torch.zeros_like(error, dtype=torch.bool)
    for step in range(iterations + 1):
        contact.evaluate(columns, trial, pushed + q)
        rho = contact.nodal(columns) - pushed - q
        size = _times(yielding, rho).abs().amax(dim=1)
        size = size / trial.abs().amax(dim=1).clamp(min=1e-9)
        better = size < error
        best, error = torch.where(better[:, None], q, best), torch.where(better, size, error)
        most = torch.where(curved & ~better, AGAIN * error, most)
        running = (error >= tolerance)[:, None]
        if step == iterations or not bool(running.any()) or (step and clock.now() > deadline):
            break
        if held is not None:
            contact.held[columns] = held
        contact.relief[columns] = _RELIEF
        contact.evaluate(columns, trial, pushed + q)
        contact.relief[columns] = 1.0
        rho = contact.nodal(columns) - pushed - q
        curved = size < most
        miss = _times(yielding, rho)
        dq = rho - contact.block(columns, torch.float32, curved).apply(miss)
        move = _times(compliance, dq)
        held = contact.expected(columns, _times(yielding, dq))
        q, trial = torch.where(running, q + dq, q), torch.where(running, trial + move, trial)
    return best, error


def _times(compliance: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    return (compliance @ q[:, :, None])[:, :, 0]
