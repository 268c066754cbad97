"""Whether an object has snapped: the bodies have done work that is neither stored nor taken up by friction."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.physics.solve.newton import Equilibrium

SNAP = 0.05
"""Share of the energy that the bodies have put into the object, which a step may lose [-]."""
_ROUNDING = 1e-4  # of the elastic energy, which a state balanced to a tier's tolerance may lack [-]


class WorkCheck:
    """The energies at the equilibria that the steps of a batch of touches begin from.

    Along a step the bodies have done the work of their force, at the least that of the smaller of the forces at its
    ends. The object stores it, or friction has taken it up: the limits times the ways of slip, at the larger push of
    both ends. Where both are less, the rest has become motion: the object has snapped, as a column does that buckles.
    Where it comes to rest depends on that motion, which this solver does not know. In shorter steps an object on its
    way loses nothing, and one that snaps as much.

    Made when no body touches the object yet, at the equilibrium under its weight.

    Args:
        balance: the touches.
    """

    def __init__(self, balance: Equilibrium):
        self._balance = balance
        balance.evaluate(balance.every)
        self._rest = self._begun = self._stored(balance.every)
        self._force = balance.contact.on_bodies(balance.every)
        self._elastic = torch.zeros_like(self._rest)

    def begin(self, columns: torch.Tensor) -> None:
        """Steps of ``columns`` (k,) begin at the states that were evaluated last."""
        self._begun, self._force, self._elastic = self._begun.clone(), self._force.clone(), self._elastic.clone()
        self._begun[columns] = self._stored(columns)
        self._force[columns] = self._balance.contact.on_bodies(columns)
        self._elastic[columns] = wp.to_torch(self._balance.elasticity.energy)[columns]

    def snapped(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray) -> torch.Tensor:
        """Which of ``columns`` (k,), evaluated last at the end of their step from ``before`` to ``pose`` (B, K, 4, 4),
        have lost energy (k,) bool. Bodies that turn or retreat, and sheets, are not asked."""
        contact, host = self._balance.contact, columns.cpu().numpy()
        if not contact.solid:
            return torch.zeros(len(columns), dtype=torch.bool, device=columns.device)
        way = torch.as_tensor((pose - before)[host][..., :3, 3], device=columns.device)
        straight = torch.as_tensor((pose[host, ..., :3, :3] == before[host, ..., :3, :3]).all(axis=(1, 2, 3)),
                                   device=columns.device)  # the moments do no work
        first, last = self._force[columns], contact.on_bodies(columns)
        put, found = (-(force * way).sum(dim=(1, 2)) for force in (first, last))
        inward = put > 0.5 * (first.norm(dim=2) * way.norm(dim=2)).sum(dim=1)
        push, push_before = (force.norm(dim=2).sum(dim=1) for force in (last, first))
        taken = contact.energy(columns) * (push_before / push.clamp(min=1e-300)).clamp(min=1.0)
        begun = self._begun[columns]
        may_lose = SNAP * (begun - self._rest[columns]).clamp(min=0.0) + _ROUNDING * self._elastic[columns]
        kept = begun - may_lose + torch.minimum(found, put).clamp(min=0.0)
        return inward & straight & (self._stored(columns) + taken < kept)

    def _stored(self, columns: torch.Tensor) -> torch.Tensor:
        """Energy of object, weight and springs in the states that were evaluated last (k,) [J]."""
        balance = self._balance
        energy = wp.to_torch(balance.elasticity.energy)[columns]
        return energy + balance.contact.carried(columns) - (balance.load * balance.u[:, columns]).sum(dim=0)
