"""What a step begins from: the guess of least potential, its contact corrected by the condensed problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.solve import path
from vsfsim.physics.solve.newton import Equilibrium

_RENEWALS = 2  # of the friction limits, after which their condensed problem is solved again
_WILD = 1e-3  # error of a condensed problem from which on the guess as it is may be the better one
_USEFUL = 0.1  # error of a condensed problem up to which its forces are better than none


class Known(NamedTuple):
    """An equilibrium that later frames may begin from."""

    pose: np.ndarray
    """Poses (B, K, 4, 4)."""
    u: torch.Tensor
    """Displacements (3 n, B) [m]."""
    force: torch.Tensor
    """Contact forces, see `Contact.remember` [N]."""
    dof: torch.Tensor
    """Degrees of freedom of the patches that they act on (B, 3 s), see `Contact`."""


def guesses(equilibria: Sequence[Known], present: tuple[torch.Tensor, torch.Tensor], pose: np.ndarray,
            contact: Contact) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """What a step to ``pose`` (B, K, 4, 4) may begin from: the present state, and the last two equilibria extrapolated.

    Args:
        equilibria: that are known, in order.
        present: displacements (3 n, B) [m] and forces on the patches (B, 3 s) [N].
        pose, contact: see above.

    Returns:
        Displacements and forces as of ``present``.
    """
    out = [present]
    if len(equilibria) > 1:
        first, second = equilibria[-2:]
        f0, f1 = (_on_patches(known, contact) for known in (first, second))
        ratio = torch.as_tensor(path.ratio(first.pose, second.pose, pose), device=f1.device)
        out.append((second.u + (ratio * (second.u - first.u)).to(second.u.dtype), f1 + ratio[:, None] * (f1 - f0)))
    return out


def _on_patches(known: Known, contact: Contact) -> torch.Tensor:
    """The forces of an equilibrium on the present patches (B, 3 s) [N], which may have grown since."""
    if known.force.shape == contact.no_force().shape:
        return contact.recall(known.force)
    everywhere = spread(known.dof, known.force, len(known.u))
    return everywhere.gather(0, contact.dof.clamp(min=0).T).T * contact.mask


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
            change, error = contact.condensed(columns, contact.gather(base)[columns], force[columns], iterations=20,
                                              tolerance=1e-4)
        # of a body that responds otherwise than at rest, near a bifurcation, say, the correction may lead anywhere
        wild = error > _WILD
        for part in (1.0, 0.0) if contact.shifts and base is not guesses[0][0] and bool(wild.any()) else (1.0,):
            corrected = part * change
            balance.u[:, columns] = base[:, columns] + contact.response.patch(columns, corrected).to(balance.real)
            state = balance.evaluate(columns)
            state["potential"][state["potential"] < balance.least[columns]] = float("inf")
            better = (state["wrong_side"] < wrong_side) | ((state["wrong_side"] == wrong_side)
                                                           & (state["potential"] < best))
            better &= wild | (part == 1.0)
            best = torch.where(better, state["potential"], best)
            wrong_side = torch.where(better, state["wrong_side"], wrong_side)
            chosen[:, columns[better]] = balance.u[:, columns[better]]
            pushed[better] = (force[columns] + corrected)[better]
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
