"""What a step begins from: the guess of least potential, its contact corrected by the condensed problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.solve import increments
from vsfsim.physics.solve.newton import Equilibrium

_RENEWALS = 2  # of the friction limits, after which their condensed problem is solved again
_WILD = 1e-3  # error of a condensed problem from which on the guess as it is may be the better one
_TIMES = (1.5, 2.0, 3.0)  # the first equilibrium, as a guess at the second where its correction leads astray
_USEFUL = 0.1  # error of a condensed problem up to which its forces are better than none


class Known(NamedTuple):
    """An equilibrium that later frames may begin from."""

    pose: np.ndarray
    """Poses (B, K, 4, 4)."""
    u: torch.Tensor
    """Displacements (3 n, B) [m]."""
    force: torch.Tensor
    """Contact forces (3 n, B) [N]."""


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
        f0, f1 = (contact.gather(known.force) for known in (first, second))
        ratio = torch.as_tensor(increments.ratio(first.pose, second.pose, pose), device=f1.device)
        out.append((second.u + (ratio * (second.u - first.u)), f1 + ratio[:, None] * (f1 - f0)))
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
    best, every = _Best(balance, columns, last[columns]), torch.ones_like(columns, dtype=torch.bool)
    tries = list(guesses)
    for number, (base, force) in enumerate(tries):
        if number and clock.now() > contact.deadline:
            break
        with clock.measure("prediction"):
            change, error = contact.condensed(columns, contact.gather(base)[columns], force[columns], iterations=20,
                                              tolerance=1e-4)
        moved = base[:, columns] + contact.response.patch(columns, change)
        best.offer(moved, force[columns] + change, every)
        # of a body that responds otherwise than at rest, near a bifurcation, say, the correction may lead anywhere
        wild = error > _WILD
        if not (contact.solid and bool(wild.any())):
            continue
        if number:
            best.offer(base[:, columns], force[columns], wild)
        elif len(guesses) == 1:
            tries += [(times * base, times * force) for times in _TIMES]
    best.offer(now[:, columns], last[columns], every, present=True)
    balance.u.copy_(now)
    balance.u[:, columns], pushed = best.u, best.force
    if not (contact.has_friction and contact.solid):
        return
    _renew(balance, columns)
    for _ in range(_RENEWALS):
        if clock.now() > contact.deadline:
            break
        with clock.measure("prediction"):
            change, error = contact.condensed(columns, contact.gather(balance.u)[columns], pushed, iterations=20,
                                              tolerance=1e-4)
        change[error > _USEFUL] = 0.0
        balance.u[:, columns] += contact.response.patch(columns, change)
        pushed += change
        _renew(balance, columns)


class _Best:
    """Of the states on offer for the touches ``columns`` (k,) those with the fewest points on the wrong side of a body,
    and of these the one of least potential."""

    u: torch.Tensor
    """Its displacements (3 n, k) [m]."""
    force: torch.Tensor
    """Its contact forces on the patches (k, 3 s) [N]."""

    def __init__(self, balance: Equilibrium, columns: torch.Tensor, force: torch.Tensor):
        self._balance, self._columns = balance, columns
        self._potential = torch.full((len(columns),), float("inf"), dtype=torch.float64, device=balance.device)
        self._wrong_side = torch.full_like(columns, torch.iinfo(torch.int64).max, dtype=torch.int64)
        self.u, self.force = balance.u[:, columns], force

    def offer(self, u: torch.Tensor, force: torch.Tensor, which: torch.Tensor, *, present: bool = False) -> None:
        """Take a state for those of ``which`` (k,) bool that it is better for. The ``present`` one wins where it is as
        good, and is no other solution branch, which the others may be."""
        balance = self._balance
        balance.u[:, self._columns] = u
        state = balance.evaluate(self._columns)
        potential, wrong_side = state["potential"], state["wrong_side"]
        if not present:
            potential[potential < balance.least[self._columns]] = float("inf")
        less = potential <= self._potential if present else potential < self._potential
        better = which & ((wrong_side < self._wrong_side) | ((wrong_side == self._wrong_side) & less))
        self._potential = torch.where(better, potential, self._potential)
        self._wrong_side = torch.where(better, wrong_side, self._wrong_side)
        self.u = torch.where(better, u, self.u)
        self.force = torch.where(better[:, None], force, self.force)


def _renew(balance: Equilibrium, columns: torch.Tensor) -> None:
    balance.evaluate(columns)
    balance.contact.update_friction(columns)
