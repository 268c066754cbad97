"""Which states lie on another branch than the equilibrium that a step begins from: a body has been let through."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.solve.newton import Equilibrium


def bar(balance: Equilibrium, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray) -> None:
    """Bar states of ``columns`` (k,) that have less potential than the present equilibria, on the way to ``pose``.

    A body that moves on against the force on it does work, so without friction the potential grows. A state of less has
    let the body through, between the contact points or around it.

    Args:
        balance: the touches; its ``least`` is set.
        columns: touches (k,).
        before, pose: poses of the equilibria, and at the end of the step (B, K, 4, 4).
    """
    contact = balance.contact
    if contact.has_friction or not contact.shifts:
        return
    contact.move(before, columns)
    potential = balance.evaluate(columns)["potential"]
    way = torch.as_tensor((pose - before)[..., :3, 3], device=balance.device)[columns]
    force = contact.on_bodies(columns)
    work, most = -(force * way).sum(dim=(1, 2)), (force.norm(dim=2) * way.norm(dim=2)).sum(dim=1)
    balance.least[columns] = torch.where(work > 0.5 * most, potential, -float("inf"))


def lift(balance: Equilibrium, columns: torch.Tensor) -> None:
    """Let ``columns`` (k,) go where they will."""
    balance.least[columns] = -float("inf")
