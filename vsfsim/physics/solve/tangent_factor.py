"""A factor of the tangent at a deformed state as preconditioner, for touches that the rest-state factor serves badly.

Far from rest the rest-state factor lets a linear system take a hundred conjugate gradients. A factor of the projected
tangent with the contact's own stiffness in it (without its geometric term) lets it take ten, for the cost of some
fifty. It is made where the iterations beyond those ten have added up to more than that, and made again when they have
once more: what is decided counts iterations, never time. It serves until then, also in the next frames.
"""

from __future__ import annotations

import functools
import time

import numpy as np
import torch
import warp as wp

from vsfsim.core.errors import MeshError
from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.linear.elimination import Order
from vsfsim.physics.linear.multifrontal import Multifrontal
from vsfsim.physics.linear.rest_factor import RestFactor
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity

_FEW = 4  # touches of a batch: each has a factor of its own
_USUAL = 10  # conjugate gradients of a linear system that are no reason for another factor
# those beyond `_USUAL` after which a factor is made: of one frame with the rest-state factor, and of all with an own
_FIRST, _AGAIN = 60, 60
_BYTES = 1e9  # of a factor while it is made
_GAIN = 0.7  # share of the iterations before that the first system with a new factor may take


class TangentFactors:
    """The factors of the touches of one run; there are none on a GPU, with many touches, or under other contact than
    that of rigid bodies with a solid.

    Args:
        model: the body.
        elasticity: its elements, begun for the batch.
        contact: the contact.
    """

    def __init__(self, model: Model, elasticity: Elasticity, contact: Contact):
        self._model, self._elasticity, self._contact = model, elasticity, contact
        self._own: list[Multifrontal | None] = [None] * contact.batch
        self._softening = np.ones(contact.batch)  # of the contact in each
        # iterations beyond the usual ones, and the most of a linear system, since the factor was made
        self._spent, self._most = np.zeros(contact.batch, int), np.zeros(contact.batch, int)
        self._tried = np.zeros(contact.batch, int)  # that most, before a factor that has not been used yet
        self._lost = np.zeros(contact.batch, bool)  # whose new factor was no better
        self._serves = (contact.device == "cpu" and contact.shifts and contact.batch <= _FEW
                        and not any(block.collective for block in model.blocks))
        self._seconds = 0.0

    def begin_frame(self) -> None:
        """Count the iterations with the rest-state factor from zero."""
        rest = [own is None for own in self._own]
        self._spent[rest] = self._most[rest] = 0
        self._lost[:] = False

    def of(self, touch: int) -> Multifrontal | None:
        """The factor that preconditions a touch, or None for that of the rest state."""
        own = self._own[touch]
        return own if own is not None and self._softening[touch] == float(self._contact.softening[touch]) else None

    def count(self, columns: torch.Tensor, steps: torch.Tensor) -> None:
        """Note the iterations ``steps`` (k,) of a linear system of each of the touches ``columns`` (k,)."""
        if not self._serves:
            return
        for b, number in zip(columns.tolist(), steps.tolist(), strict=True):
            if self._tried[b] and number > _GAIN * self._tried[b]:
                self._own[b], self._lost[b] = None, True
            self._tried[b] = 0
            self._spent[b] += max(0, number - _USUAL)
            self._most[b] = max(self._most[b], number)

    def renew(self, columns: torch.Tensor, u: torch.Tensor, deadline: float) -> torch.Tensor:
        """Make factors at the displacements u (3 n, B) [m] for those of the touches ``columns`` (k,) that need one and
        whose factor would be ready before the ``deadline`` of `time.perf_counter`. Returns for which (k,) bool: the
        tangents that `Elasticity` holds of these are projected ones now."""
        made = torch.zeros(len(columns), dtype=torch.bool, device=columns.device)
        if not self._serves or not self._contact.symmetric:
            return made
        for k, b in enumerate(columns.tolist()):
            if self._lost[b] or self._spent[b] <= (_FIRST if self._own[b] is None else _AGAIN):
                continue
            if time.perf_counter() + self._duration() > deadline:
                continue  # it would not be ready
            with clock.measure("tangent factors"):
                self._own[b] = self._make(columns[k:k + 1], u)
            made[k] = True
            self._lost[b] = self._own[b] is None
            self._softening[b] = float(self._contact.softening[b])
            self._spent[b], self._tried[b], self._most[b] = 0, self._most[b], 0
        return made

    @functools.cached_property
    def _rest(self) -> RestFactor:
        return self._model.predictor("cpu")

    def _duration(self) -> float:
        """Expected duration of a new factor [s]."""
        return self._seconds or 1.5 * self._rest.seconds

    def _make(self, column: torch.Tensor, u: torch.Tensor) -> Multifrontal | None:
        began = time.perf_counter()
        order = self._rest.order(self._model.mesh.points)
        if order.bytes > _BYTES:
            return None
        self._elasticity.tangent(wp.from_torch(column.to(torch.int32)), wp.from_torch(u), projected=True)
        values = np.zeros((len(order.neighbours), 3, 3))
        self._elasticity.add_matrices(int(column[0]), order, values)
        self._add_contact(column, order, values)
        free = self._model.free.reshape(-1, 3)
        values *= free[order.owners][:, :, None] * free[order.neighbours][:, None, :]
        diagonal = order.owners == order.neighbours
        values[diagonal] += (1.0 - free[order.owners[diagonal]])[:, :, None] * np.eye(3)
        try:
            out = Multifrontal(order, values)
        except MeshError:  # rounding
            return None
        self._seconds = time.perf_counter() - began
        return out

    def _add_contact(self, column: torch.Tensor, order: Order, values: np.ndarray) -> None:
        stiffness = self._contact.stiffness(column)
        matrix = stiffness.matrices[0].tocoo() if hasattr(stiffness, "matrices") else None
        if matrix is None:
            row, col = (i.numpy() for i in stiffness[0].nonzero(as_tuple=True))
            data = stiffness[0].numpy()[row, col]
        else:
            row, col, data = matrix.row, matrix.col, matrix.data
        dof = self._contact.dof[int(column[0])].numpy()
        row, col = dof[row], dof[col]
        at = order.find(row // 3, col // 3)
        on = (at >= 0) & (row >= 0) & (col >= 0)
        np.add.at(values, (at[on], row[on] % 3, col[on] % 3), data[on])
