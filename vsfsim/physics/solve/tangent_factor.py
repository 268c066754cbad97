"""A factor of the tangent at a deformed state, for touches that the rest-state factor serves badly.

Far from rest the rest-state factor lets a linear system take a hundred conjugate gradients. A factor of the projected
tangent with the contact's own stiffness in it (without its geometric term) lets it take a few. It is made where the
iterations beyond the usual ones have added up to what it costs, and made again when they have once more: what is
decided counts iterations, never time. It serves until then, also in the next frames.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.core.errors import MeshError
from vsfsim.physics import clock
from vsfsim.physics.contact.points import Contact
from vsfsim.physics.linear.cholesky import Cholesky, Order
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity, LinearElasticity

_USUAL = 12  # conjugate gradients of a linear system that are no reason for another factor
_WORK = 10.0  # `Order.work` for each iteration that a factor costs, measured on bodies of 1,500 to 23,000 nodes
_BYTES = 2e9  # of the factors of all touches


class TangentFactors:
    """The factors of the touches of one run; there are none on a GPU, under other contact than that of rigid bodies
    with a solid, or at small strain, where that of the rest state is the tangent's own.

    Args:
        model: the body.
        elasticity: its elements, begun for the batch.
        contact: the contact.
    """

    def __init__(self, model: Model, elasticity: Elasticity, contact: Contact):
        self._model, self._elasticity, self._contact = model, elasticity, contact
        self.serves = (contact.device == "cpu" and contact.solid and not isinstance(elasticity, LinearElasticity)
                       and not any(block.collective for block in model.blocks))
        self.forget()

    def forget(self) -> None:
        """Drop all factors with their counts: the contact in them was another."""
        self._own: list[Cholesky | None] = [None] * self._contact.batch
        self._spent = np.zeros(self._contact.batch, int)  # iterations beyond the usual ones since the factor was made

    def of(self, columns: torch.Tensor) -> list[Cholesky | None]:
        """The factor that preconditions each of the touches ``columns`` (k,), or None for that of the rest state."""
        return [self._own[b] for b in columns.tolist()] if self.serves else [None] * len(columns)

    def count(self, columns: torch.Tensor, steps: torch.Tensor) -> None:
        """Note the iterations ``steps`` (k,) of a linear system of each of the touches ``columns`` (k,)."""
        np.add.at(self._spent, columns.cpu().numpy(), (steps.cpu().numpy() - _USUAL).clip(min=0))

    def renew(self, touches: np.ndarray, u: torch.Tensor, deadline: float) -> np.ndarray:
        """Make factors at the displacements u (3 n, B) [m] for those of the ``touches`` (k,) that need one, before the
        ``deadline`` of `clock.now`. Returns for which (k,) bool: the tangents that `Elasticity` holds of these are
        projected ones now."""
        made = np.zeros(len(touches), bool)
        if not self.serves or not self._contact.symmetric or not self._spent.any():
            return made
        order = self._model.preconditioner.order
        for k, b in enumerate(touches.tolist()):
            if (self._spent[b] <= order.work / _WORK or clock.now() > deadline
                    or 8.0 * order.entries * self._contact.batch > _BYTES):
                continue
            self._own[b] = self._make(order, torch.as_tensor(touches[k:k + 1]), u)
            made[k], self._spent[b] = True, 0
        return made

    def _make(self, order: Order, column: torch.Tensor, u: torch.Tensor) -> Cholesky | None:
        """From the projected tangent with the contact's stiffness, supports held; None where rounding spoils it."""
        self._elasticity.tangent(wp.from_torch(column.to(torch.int32)), wp.from_torch(u), projected=True)
        values = np.zeros((len(order.neighbours), 3, 3))
        self._elasticity.add_matrices(int(column[0]), order, values)
        _, stiffness = self._contact.assembled(column, torch.zeros_like(column, dtype=torch.bool))
        matrix = stiffness.matrix[0].numpy()
        there = matrix.nonzero()
        row, col = self._contact.dof[int(column[0])][stiffness.dof[0]].numpy()[np.array(there)]
        at = order.find(row // 3, col // 3)
        on = (at >= 0) & (row >= 0) & (col >= 0)
        np.add.at(values, (at[on], row[on] % 3, col[on] % 3), matrix[there][on])
        free = self._model.free.reshape(-1, 3)
        values *= free[order.owners][:, :, None] * free[order.neighbours][:, None, :]
        diagonal = order.owners == order.neighbours
        values[diagonal] += (1.0 - free[order.owners[diagonal]])[:, :, None] * np.eye(3)
        try:
            return Cholesky(order, values, self._model.preconditioner.real)
        except MeshError:
            return None
