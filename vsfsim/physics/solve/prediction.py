"""What a step begins from: the guess of least potential, its contact corrected by the condensed problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.solve import path
from vsfsim.physics.solve.newton import Equilibrium

_RENEWALS = 2  # of the friction limits, after which their condensed problem is solved again
_USEFUL = 0.1  # error of a condensed problem up to which its forces are better than none


class Known(NamedTuple):
    """An equilibrium that later frames may begin from."""

    pose: np.ndarray
    """Poses (B, K, 4, 4)."""
    u: torch.Tensor
    """Displacements (3 n, B) [m]."""
    force: torch.Tensor
    """Contact forces, see `Contact.remember` [N]."""


def guesses(equilibria: Sequence[Known], present: tuple[torch.Tensor, torch.Tensor], pose: np.ndarray,
            contact: Contact, shape: torch.Size) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """What a step to ``pose`` (B, K, 4, 4) may begin from: the present state, and the last two equilibria extrapolated.

    Args:
        equilibria: that are known, in order.
        present: displacements (3 n, B) [m] and forces on the patches (B, 3 s) [N].
        pose, contact: see above.
        shape: of remembered contact forces; equilibria on other patches are not extrapolated.

    Returns:
        Displacements and forces as of ``present``.
    """
    out = [present]
    if len(equilibria) > 1 and equilibria[-2].force.shape == shape:
        (p0, u0, f0), (p1, u1, f1) = equilibria[-2:]
        f0, f1 = contact.recall(f0), contact.recall(f1)
        ratio = torch.as_tensor(path.ratio(p0, p1, pose), device=u1.device)
        out.append((u1 + (ratio * (u1 - u0)).to(u1.dtype), f1 + ratio[:, None] * (f1 - f0)))
    return out


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
