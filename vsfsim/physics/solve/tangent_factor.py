"""A factor of the tangent at a deformed state as preconditioner, for touches that the rest-state factor serves badly.

Far from rest the rest-state factor lets a linear system take a hundred conjugate gradients. First a factor of the
projected tangent at the nodes that are deformed most, with the contact's own stiffness in it (without its geometric
term), corrects it (`local_factor`): that costs some five iterations. A factor of that tangent as a whole lets a system
take ten, for the cost of some fifty. Each is made where the iterations beyond the usual ones have added up to more than
that, and made again when they have once more: what is decided counts iterations, never time. It serves until then, also
in the next frames.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import scipy.sparse as sp
import torch
import warp as wp

from vsfsim.core.errors import MeshError
from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.linear.elimination import Order
from vsfsim.physics.linear.local_factor import LocalFactor
from vsfsim.physics.linear.multifrontal import Multifrontal
from vsfsim.physics.linear.rest_factor import RestFactor
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity

_FEW = 4  # touches of a batch: each has a factor of its own
_USUAL = 10  # conjugate gradients of a linear system that are no reason for another factor
# those beyond `_USUAL` after which a factor is made: of one frame with the rest-state factor, and of all with an own
_FIRST, _AGAIN = 60, 60
_WORK = 6.5  # `Order.work` for each iteration that a factor costs, measured on bodies of 6,000 to 34,000 nodes
_BYTES = 1e9  # of a factor while it is made
# of the local factor: usual iterations, and those beyond them after which it is made; its nodes at most, and the
# least displacement gradient there
_NEAR_USUAL, _NEAR = 6, 10
_VOLUME_USUAL, _VOLUME_NEAR = 3, 3  # the same in nearly incompressible bodies, whose systems take most of the time
_NODES, _DEFORMED = 600, 0.03
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
        # iterations beyond the usual ones, and the most of a linear system, since the factor was made
        self._spent, self._most = np.zeros(contact.batch, int), np.zeros(contact.batch, int)
        self._tried = np.zeros(contact.batch, int)  # that most, before a factor that has not been used yet
        self._lost = np.zeros(contact.batch, bool)  # whose new factor was no better
        self._local: list[LocalFactor | None] = [None] * contact.batch
        self._near_spent = np.zeros(contact.batch, int)  # iterations beyond the usual ones since that one was made
        self._near_usual, self._near = ((_VOLUME_USUAL, _VOLUME_NEAR) if model.keeps_volume else (_NEAR_USUAL, _NEAR))
        self._no_local = np.zeros(contact.batch, bool)  # who cannot have one
        self._begin = np.zeros((contact.batch, len(model.free)))  # displacements that each factor was made at [m]
        self._serves = (contact.device == "cpu" and contact.solid and contact.batch <= _FEW
                        and not any(block.collective for block in model.blocks))
        self._seconds = 0.0

    def begin_frame(self) -> None:
        """Count the iterations with the rest-state factor from zero."""
        rest = [own is None for own in self._own]
        self._spent[rest] = 0
        self._near_spent[[own is None and part is None for own, part in zip(self._own, self._local, strict=True)]] = 0
        self._lost[:] = self._no_local[:] = False

    def of(self, touch: int) -> Multifrontal | None:
        """The factor that preconditions a touch, or None for that of the rest state."""
        return self._own[touch]

    def local_of(self, touch: int) -> LocalFactor | None:
        """The local factor that corrects the factor of a touch, or None."""
        return self._local[touch]

    def forget(self) -> None:
        """Drop all factors with their counts and places: the contact in them was another."""
        batch = len(self._own)
        self._own, self._local = [None] * batch, [None] * batch
        for of_them in (self._spent, self._most, self._tried, self._near_spent, self._begin):
            of_them[:] = 0

    def count(self, columns: torch.Tensor, steps: torch.Tensor) -> None:
        """Note the iterations ``steps`` (k,) of a linear system of each of the touches ``columns`` (k,)."""
        if not self._serves:
            return
        for b, number in zip(columns.tolist(), steps.tolist(), strict=True):
            if self._tried[b] and number > _GAIN * self._tried[b]:
                self._own[b], self._local[b], self._lost[b] = None, None, True
            self._tried[b] = 0
            self._spent[b] += max(0, number - _USUAL)
            self._near_spent[b] += max(0, number - self._near_usual)
            self._most[b] = max(self._most[b], number)

    def drop(self, columns: torch.Tensor) -> bool:
        """Drop the factors of the touches ``columns`` (k,) until the next frame, but let one that had a factor of the
        whole have a local one instead; whether one of them had any."""
        had = False
        for b in columns.tolist():
            had |= self._own[b] is not None or self._local[b] is not None
            self._no_local[b] |= self._own[b] is None
            self._own[b], self._local[b], self._lost[b] = None, None, True
        return had

    def renew(self, columns: torch.Tensor, u: torch.Tensor, deadline: float) -> torch.Tensor:
        """Make factors at the displacements u (3 n, B) [m] for those of the touches ``columns`` (k,) that need one and
        whose factor would be ready before the ``deadline`` of `clock.now`. Returns for which (k,) bool: the
        tangents that `Elasticity` holds of these are projected ones now."""
        made = torch.zeros(len(columns), dtype=torch.bool, device=columns.device)
        if not self._serves or not self._contact.symmetric:
            return made
        for k, b in enumerate(columns.tolist()):
            whole, late = self._is_due(b, deadline), clock.now() >= deadline
            if not whole and self._near_spent[b] > self._near and not self._no_local[b] and not late:
                if self._local[b] is None:
                    self._spent[b] = 0  # before a factor of the whole the local one has its turn
                with clock.measure("local factors"):
                    self._local[b] = self._make_local(columns[k:k + 1], u)
                made[k], self._near_spent[b] = True, 0
                self._no_local[b] = self._local[b] is None
            if not whole:
                continue
            with clock.measure("tangent factors"):
                self._own[b] = self._make(columns[k:k + 1], u)
            made[k] = True
            self._lost[b] = self._own[b] is None
            self._local[b], self._begin[b] = None, u[:, b].clone().numpy()
            self._spent[b] = self._near_spent[b] = 0
            self._tried[b], self._most[b] = self._most[b], 0
        return made

    def _is_due(self, touch: int, deadline: float) -> bool:
        """Whether a touch is to have a factor of the whole now: before another local one where its iterations have cost
        as much. One that would not be ready in time is not begun."""
        spent = self._spent[touch]
        if self._lost[touch] or spent <= (_FIRST if self._own[touch] is None else _AGAIN):
            return False
        return bool((self._no_local[touch] or spent > self._order.work / _WORK)
                    and clock.now() + self._duration() <= deadline)

    @functools.cached_property
    def _rest(self) -> RestFactor:
        return self._model.predictor("cpu")

    def _duration(self) -> float:
        """Expected duration of a new factor [s]."""
        return self._seconds or 1.5 * self._rest.seconds

    def _make(self, column: torch.Tensor, u: torch.Tensor) -> Multifrontal | None:
        began = clock.now()
        order = self._order
        if order.bytes > _BYTES:
            return None
        try:
            out = Multifrontal(order, self._matrix(column, u)[0])
        except MeshError:  # rounding
            return None
        self._seconds = clock.now() - began
        return out

    def _make_local(self, column: torch.Tensor, u: torch.Tensor) -> LocalFactor | None:
        b = int(column[0])
        moved = (u[:, b].numpy() - self._begin[b]).reshape(-1, 3)
        turned = np.zeros(len(moved))  # an estimate of the displacement gradient since the factor was made
        for block in self._model.blocks:
            if block.nodes.shape[1] < 2:
                continue
            change, place = (a[block.nodes] - a[block.nodes].mean(axis=1, keepdims=True)
                             for a in (moved, self._model.mesh.points))
            own = np.sqrt((change**2).sum(axis=(1, 2)) / np.maximum((place**2).sum(axis=(1, 2)), 1e-300))
            np.maximum.at(turned, block.nodes.ravel(), np.repeat(own, block.nodes.shape[1]))
        stiffness = self._contact.stiffness(column)
        touched = touched_unknowns(self._contact, stiffness, 0, b)
        turned[touched // 3] = np.inf
        most = np.sort(np.argsort(-turned, kind="stable")[:_NODES])
        at_nodes = np.zeros(len(turned), bool)
        at_nodes[most[turned[most] > _DEFORMED]] = True
        own = np.repeat(at_nodes, 3)
        free = own & (self._model.free > 0.0)
        if not free.any():
            return None
        order = self._order
        values, here = self._matrix(column, u, at_nodes)
        start = np.concatenate([[0], np.cumsum(np.diff(order.start)[at_nodes])])
        rows = sp.bsr_matrix((values, order.neighbours[here], start), shape=(own.sum(), len(own))).tocsr()
        try:
            return LocalFactor(rows[free[own]], np.flatnonzero(free), touched)
        except MeshError:
            return None

    @property
    def _order(self) -> Order:
        return self._rest.order(self._model.mesh.points)

    def _matrix(self, column: torch.Tensor, u: torch.Tensor, at_nodes: np.ndarray | None = None,
                ) -> tuple[np.ndarray, np.ndarray | slice]:
        """Blocks of the projected tangent with the contact's stiffness, supports held, and their numbers in the order;
        only those in the rows of ``at_nodes`` if these are given."""
        order = self._order
        self._elasticity.tangent(wp.from_torch(column.to(torch.int32)), wp.from_torch(u), projected=True)
        values = np.zeros((len(order.neighbours), 3, 3))
        self._elasticity.add_matrices(int(column[0]), order, values, at_nodes)
        self._add_contact(column, order, values)
        here = slice(None) if at_nodes is None else np.flatnonzero(at_nodes[order.owners])
        values, owners, neighbours = values[here], order.owners[here], order.neighbours[here]
        free = self._model.free.reshape(-1, 3)
        values *= free[owners][:, :, None] * free[neighbours][:, None, :]
        diagonal = owners == neighbours
        values[diagonal] += (1.0 - free[owners[diagonal]])[:, :, None] * np.eye(3)
        return values, here

    def _add_contact(self, column: torch.Tensor, order: Order, values: np.ndarray) -> None:
        row, col, data = _entries(self._contact.stiffness(column), 0)
        dof = self._contact.dof[int(column[0])].numpy()
        row, col = dof[row], dof[col]
        at = order.find(row // 3, col // 3)
        on = (at >= 0) & (row >= 0) & (col >= 0)
        np.add.at(values, (at[on], row[on] % 3, col[on] % 3), data[on])


def touched_unknowns(contact: Contact, stiffness: Any, entry: int, touch: int) -> np.ndarray:
    """Unknowns of a body (t,) at which contact's ``stiffness`` on the CPU, its ``entry``, is not 0 for a ``touch``."""
    unknowns = contact.dof[touch].numpy()[_entries(stiffness, entry)[0]]
    return np.unique(unknowns[unknowns >= 0])


def _entries(stiffness: Any, entry: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and values of contact's stiffness of one touch on a CPU, with bodies that do not give way."""
    matrix = getattr(stiffness, "fixed", stiffness).matrices[entry].tocoo()
    return matrix.row, matrix.col, matrix.data
