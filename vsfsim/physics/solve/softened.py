"""Softer contact, which leads the way to an equilibrium that is far from where a step begins."""

from __future__ import annotations

import torch

from vsfsim.physics.solve.frames import Reason
from vsfsim.physics.solve.newton import Equilibrium

_SOFTENINGS, _TOLERANCE = (0.003, 0.05), 0.05  # of the contact stiffness, stage by stage; their tolerance


def lead(balance: Equilibrium, columns: torch.Tensor, begin: torch.Tensor, deadline: float) -> None:
    """Bring ``columns`` (k,) near equilibrium through softer contact, from the displacements ``begin`` (3 n, B) [m].
    Where that leads to no balance, around a body that is deep in the object, say, the present guess stays."""
    contact = balance.contact
    guess, least = balance.u.clone(), balance.least.clone()
    balance.least[columns] = -float("inf")
    balance.u[:, columns] = begin[:, columns]
    for softening in _SOFTENINGS:
        contact.softening[columns] = softening
        balance.solve(columns, balance.evaluate(columns), _TOLERANCE, deadline)
        failed = columns[torch.as_tensor(balance.reason[columns.cpu().numpy()] != Reason.NONE, device=balance.device)]
        balance.u[:, failed] = guess[:, failed]
        contact.softening[failed] = 1.0
        columns = columns[(contact.softening[columns] < 1.0).nonzero()[:, 0]]
        if not len(columns):
            break
    contact.softening[columns] = 1.0
    balance.least = least
