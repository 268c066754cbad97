"""The condensed contact problem: the body answers the contact as it would at rest, and only the patches are unknown.

On a patch's degrees of freedom the rest-state compliance A gives the elastic answer of the whole body,

    u_S = u0_S + A q,     q = f(u_S) - f0,

which is the stationary point of 1/2 q^T A q + f0 . A q + (energy of the contact); a semi-smooth Newton method with a
line search on that energy solves it for all touches at once. It is the `linear` tier, and the prediction of the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from vsfsim.physics.contact import rigid_points as contact

if TYPE_CHECKING:
    from vsfsim.physics.contact.rigid import Touching

_SLACK = 1e-12  # of the energy: rounding of the sum over the patch
_BLUNT = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the stick stiffness, stage by stage
_ROUGH = 1e-3  # tolerance of the stages that only lead the way
_LEAST = 1e-4  # shortest step of the line search
_SHRINK = 0.8  # of the touches still run: then the others are left behind


def solve(touching: Touching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float,
          start: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Change of the contact forces when the bodies stand where `Touching.move` put them.

    Args:
        touching: contact. columns: touches (k,). base: displacements of their patches before (k, 3 s) [m].
        pushed: contact forces before (k, 3 s) [N]. iterations: limit. tolerance: relative error of the patch's
        displacements.
        start: changes (k, 3 s) [N] to begin with, or None for none.

    Returns:
        Changes (k, 3 s) [N] and the relative errors left (k,).
    """
    if not touching.rubs:
        return _newton(touching, columns, base, pushed, start, iterations, tolerance)
    touching.stick = contact.STICK
    answer, error = _newton(touching, columns, base, pushed, start, iterations, tolerance)
    again = (error > tolerance).nonzero()[:, 0]
    if len(again):
        # the kink between stick and slip is sharp: come to it from a blunt one
        part = None if start is None else start[again]
        for share in _BLUNT:
            touching.stick = share * contact.STICK
            part, new = _newton(touching, columns[again], base[again], pushed[again], part, 3 * iterations,
                                tolerance if share == 1.0 else _ROUGH)
        better = new < error[again]
        answer[again[better]], error[again[better]] = part[better], new[better]
    return answer, error


def _newton(touching: Touching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor,
            start: torch.Tensor | None, iterations: int,
            tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    compliance = touching.compliance[columns]
    q = torch.zeros_like(base) if start is None else start.clone()
    trial = base + _times(compliance, q) if start is not None else base.clone()
    best, best_error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    # which of the touches are still looked at, None for all; left behind in crowds, since picking costs more than
    # idling
    live = None
    dq, move = torch.zeros_like(q), torch.zeros_like(q)
    level, slope, step = best_error.clone(), torch.zeros_like(best_error), torch.ones_like(best_error)
    error = best_error.clone()
    astray = torch.full_like(level, torch.iinfo(torch.int64).max, dtype=torch.int64)
    answer = best.clone()
    running = torch.ones_like(best_error, dtype=torch.bool)
    for _ in range(iterations):
        touching.evaluate(columns, trial)
        energy = ((0.5 * q + pushed) * (trial - base)).sum(dim=1) + touching.energy(columns)
        strays = touching.astray(columns)
        far = running & ((strays > astray) | (energy > level - 1e-4 * step * slope + _SLACK
                                              * level.abs())) & (step > _LEAST)
        # too far: back half of what is left of this step
        step = torch.where(far, 0.5 * step, step)
        back = torch.where(far, step, 0.0)[:, None]
        nodal = touching.nodal(columns)
        rho = nodal - pushed - q
        miss = _times(compliance, rho)
        size = miss.abs().amax(dim=1) / trial.abs().amax(dim=1).clamp(min=1e-9)
        fresh = running & ~far
        better = fresh & (size < error)
        answer = torch.where(better[:, None], nodal - pushed, answer)
        error = torch.where(better, size, error)
        running = running & (far | (size >= tolerance))
        left = int(running.sum())
        if left == 0:
            break
        ahead = running & ~far
        if bool(ahead.any()):
            new = rho - touching.block(columns).apply(miss)
            dq = torch.where(ahead[:, None], new, dq)
            move = torch.where(ahead[:, None], _times(compliance, new), move)
            level, slope = torch.where(ahead, energy, level), torch.where(ahead, (new * miss).sum(dim=1), slope)
            step = torch.where(ahead, 1.0, step)
            astray = torch.where(ahead, strays, astray)
        go = torch.where(ahead, 1.0, 0.0)[:, None] - back
        q = q + go * dq
        trial = trial + go * move
        if left < _SHRINK * len(columns):
            keep = running.nonzero()[:, 0]
            where = slice(None) if live is None else live
            best[where], best_error[where] = answer, error
            live = keep if live is None else live[keep]
            columns, compliance, base, pushed, q, trial, dq, move, level, slope, step, error, answer, astray = (
                x[keep] for x in (columns, compliance, base, pushed, q, trial, dq, move, level, slope, step, error,
                                  answer, astray))
            running = torch.ones_like(keep, dtype=torch.bool)
    where = slice(None) if live is None else live
    best[where], best_error[where] = answer, error
    return best, best_error


def _times(compliance: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    return (compliance @ q[:, :, None])[:, :, 0]
