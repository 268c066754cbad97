"""The condensed contact problem: the body answers the contact as it would at rest, and only the patches are unknown.

On a patch's degrees of freedom the rest-state compliance A gives the elastic answer of the whole body,

    u_S = u0_S + A q,     q = f(u_S) - f0,

which is the stationary point of 1/2 q^T A q + f0 . A q + (energy of the contact); a semi-smooth Newton method with a line search on
that energy solves it for all touches at once. It is the `linear` tier, and the prediction of the others.
"""

from __future__ import annotations

import torch

from vsfsim.physics.touching import Touching


def solve(touching: Touching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int, tolerance: float,
          start: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Change of the contact forces when the bodies stand where `Touching.move` put them.

    Args:
        touching: contact. columns: touches (k,). base: displacements of their patches before (k, 3 s) [m].
        pushed: contact forces before (k, 3 s) [N]. iterations: limit. tolerance: relative error of the patch's displacements.
        start: changes (k, 3 s) [N] to begin with, or None for none.

    Returns:
        Changes (k, 3 s) [N] and the relative errors left (k,).
    """
    compliance = touching.compliance
    count = len(columns)

    def full(value: float) -> torch.Tensor:
        return torch.full((count,), value, dtype=torch.float64, device=base.device)

    q = torch.zeros_like(base) if start is None else start.clone()
    trial = base + _times(compliance, columns, q) if start is not None else base.clone()
    dq, move = torch.zeros_like(q), torch.zeros_like(q)
    level, slope, step = full(float("inf")), full(0.0), full(1.0)
    best_error, best = full(float("inf")), q.clone()
    running = torch.ones(count, dtype=torch.bool, device=base.device)
    for _ in range(iterations):
        run = running.nonzero()[:, 0]
        at = columns[run]
        touching.evaluate(at, trial[run])
        if touching.rubs:
            touching.lag(at)
            touching.evaluate(at, trial[run])
        energy = ((0.5 * q[run] + pushed[run]) * (trial[run] - base[run])).sum(dim=1) + touching.energy(at)
        # friction's potential changes with its limit: there a step is good if it does not raise the energy much
        slack, least = (1e-2, 0.1) if touching.rubs else (1e-12, 1e-4)
        far = (energy > level[run] - 1e-4 * step[run] * slope[run] + slack * level[run].abs()) & (step[run] > least)
        if bool(far.any()):  # too far: back half of what is left of this step
            back = run[far]
            step[back] *= 0.5
            q[back] -= step[back, None] * dq[back]
            trial[back] -= step[back, None] * move[back]
            run, energy = run[~far], energy[~far]
            if not len(run):
                continue
            at = columns[run]
        nodal = touching.nodal(at)
        rho = nodal - pushed[run] - q[run]
        miss = _times(compliance, at, rho)
        error = miss.abs().amax(dim=1) / trial[run].abs().amax(dim=1).clamp(min=1e-9)
        better = error < best_error[run]
        best[run[better]] = (nodal - pushed[run])[better]
        best_error[run] = torch.minimum(error, best_error[run])
        going = error >= tolerance
        running[run] = going
        if not bool(going.all()):
            if not bool(running.any()):
                break
            run, at, rho, miss, energy = run[going], at[going], rho[going], miss[going], energy[going]
            if not len(run):
                continue
        dq[run] = rho - touching.block(at).apply(miss)
        move[run] = _times(compliance, at, dq[run])
        level[run], slope[run], step[run] = energy, (dq[run] * miss).sum(dim=1), 1.0
        q[run] += dq[run]
        trial[run] += move[run]
    return best, best_error


def _times(compliance: torch.Tensor, columns: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    own = compliance if len(columns) == len(compliance) else compliance[columns]
    return (own @ q[:, :, None])[:, :, 0]
