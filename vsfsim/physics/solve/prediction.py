"""What a step begins from: the guess of least potential, its contact corrected by the condensed problem."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from vsfsim.physics import clock
from vsfsim.physics.solve.newton import Equilibrium

_RENEWALS = 2  # of the friction limits, after which their condensed problem is solved again
_USEFUL = 0.1  # error of a condensed problem up to which its forces are better than none


def predict(balance: Equilibrium, columns: torch.Tensor, guesses: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Begin ``columns`` (k,) at the best of some guesses, or where they are if none is better.

    With friction on a solid the limits are then renewed there as Newton's method would renew them, for a condensed
    problem costs little beside its iterations.

    Args:
        balance: the touches; its displacements are set.
        columns: touches that are in contact (k,).
        guesses: displacements (3 n, B) [m] and contact forces on the patches (B, 3 s) [N]; the first are the present.
    """
    contact = balance.contact
    now, last = balance.u.clone(), guesses[0][1]
    best = torch.full((len(columns),), float("inf"), dtype=torch.float64, device=balance.device)
    wrong_side = torch.full_like(best, torch.iinfo(torch.int64).max, dtype=torch.int64)
    chosen, pushed = now.clone(), last[columns].clone()
    for base, force in guesses:
        with clock.measure("prediction"):
            change, _ = contact.condensed(columns, contact.gather(base)[columns], force[columns], iterations=20,
                                           tolerance=1e-4)
        balance.u[:, columns] = base[:, columns] + contact.response.patch(columns, change).to(balance.real)
        state = balance.evaluate(columns)
        state["potential"][state["potential"] < balance.least[columns]] = float("inf")
        better = (state["wrong_side"] < wrong_side) | ((state["wrong_side"] == wrong_side)
                                                       & (state["potential"] < best))
        best = torch.where(better, state["potential"], best)
        wrong_side = torch.where(better, state["wrong_side"], wrong_side)
        chosen[:, columns[better]] = balance.u[:, columns[better]]
        pushed[better] = (force[columns] + change)[better]
    balance.u.copy_(now)
    state = balance.evaluate(columns)
    stay = (state["wrong_side"] < wrong_side) | ((state["wrong_side"] == wrong_side) & (state["potential"] <= best))
    chosen[:, columns[stay]] = now[:, columns[stay]]
    pushed[stay] = last[columns[stay]]
    balance.u.copy_(chosen)
    if not (contact.has_friction and contact.shifts):
        return
    _renew(balance, columns)
    for _ in range(_RENEWALS):
        with clock.measure("prediction"):
            change, error = contact.condensed(columns, contact.gather(balance.u)[columns], pushed, iterations=20,
                                              tolerance=1e-4)
        change[error > _USEFUL] = 0.0
        balance.u[:, columns] += contact.response.patch(columns, change).to(balance.real)
        pushed += change
        _renew(balance, columns)


def _renew(balance: Equilibrium, columns: torch.Tensor) -> None:
    balance.evaluate(columns)
    balance.contact.update_friction(columns)
