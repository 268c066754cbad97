"""The stiffness of the contact points of `RigidContact`, on the nodes of the patches."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from vsfsim.physics.contact.face_sums import FaceSums, at_points, nodal_sums
from vsfsim.physics.contact.stiffness_block import ContactBlock, SparseStiffness, assemble, gram, many, rows_of
from vsfsim.physics.solve.mount import Springs


class PointStiffness:
    """Rows and blocks of the contact points, from their stiffness at the last evaluation."""

    batch: int
    device: str
    dof: torch.Tensor
    has_friction: bool
    coulomb: torch.Tensor
    compliance: torch.Tensor
    free: torch.Tensor
    gap: torch.Tensor
    limit: torch.Tensor
    held: torch.Tensor
    springs: Springs | None
    _sums: FaceSums | None
    _points: torch.Tensor
    _values: torch.Tensor
    _local: wp.array
    _rows: torch.Tensor
    _geometric: torch.Tensor
    _coupling: torch.Tensor

    def nodal_of(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Forces at the contact points (k, 6 f, 3) [N] as forces on the nodes (k, 3 s) [N]."""
        if self._sums is not None:
            return self._sums.nodal(columns, force)
        if self.device == "cpu":
            own, nodes = (wp.to_torch(self._local)[columns], self._values[columns]), self.dof.shape[1] // 3
            return nodal_sums(*own, force, nodes)
        return (self._points[columns].mT @ force).flatten(1)

    @property
    def symmetric(self) -> bool:
        """See `Contact`."""
        return not (self.has_friction and bool(self.coulomb.any()))

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> Any:
        """See `Contact`."""
        fixed = self._fixed_stiffness(columns, geometric)
        if self.springs is None:
            return fixed
        own, axis = self.own_stiffness(columns, geometric), self.springs.axis[columns][:, None, :, None]
        toward, back = (self.nodal_of(columns, (c @ axis)[..., 0]) * self.free[columns] for c in (own, own.mT))
        return self.springs.soften(fixed, toward, back, own, columns)

    def _fixed_stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None) -> Any:
        curved = geometric is not None and bool(geometric.any() and self._geometric[columns].any())
        some, free = columns[geometric] if curved else columns[:0], self.free[columns]
        if self._sums is None and not self._sparse(columns):
            rows = self.rows(columns)
            out = rows.mT @ rows if self.has_friction else gram(rows)
            if curved:
                out[geometric] += assemble(self._points, some, self._active(some), self._geometric, self.free[some])
            return out
        own = self.own_stiffness(columns, geometric)
        return (self._assembled(columns, own) if self._sums is None else
                self._sums.matrix(columns, own) * free[:, :, None] * free[:, None, :])

    def _active(self, columns: torch.Tensor) -> torch.Tensor:
        return (self.gap[columns] < 0.0) | (self.limit[columns] > 0.0)

    def _sparse(self, columns: torch.Tensor) -> bool:
        return not self.symmetric or many(self._active(columns))

    def _assembled(self, columns: torch.Tensor, own: torch.Tensor) -> SparseStiffness:
        return SparseStiffness.of(wp.to_torch(self._local)[columns], self._values[columns], own, self.free[columns])

    def own_stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> torch.Tensor:
        """Stiffness of the contact points (k, 6 f, 3, 3) [N/m]; ``geometric``: see `Contact.stiffness`."""
        own = self._rows[columns].mT @ self._rows[columns] + self._coupling[columns]
        if geometric is not None:
            own[geometric] += self._geometric[columns[geometric]]
        return own

    def rows(self, columns: torch.Tensor) -> torch.Tensor:
        """Rows R (k, m, 3 s) [sqrt(N/m)] of the points in contact, padded with 0: R^T R is the contact stiffness
        without its geometric term."""
        roots = self._rows if self.has_friction else self._rows[:, :, :1]
        return rows_of(self._points, columns, self._active(columns), roots) * self.free[columns][:, None, :]

    def expected(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        """Friction (k, 6 f, 3) [N] that the last evaluation expects after a move (k, 3 s) [m] of the patches."""
        at, rows = wp.to_torch(self._local)[columns], self._rows[columns][:, :, 1:]
        return self.held[columns] + (rows.mT @ (rows @ at_points(at, self._values[columns], move)[..., None]))[..., 0]

    def block(self, columns: torch.Tensor, real: torch.dtype = torch.float64,
              geometric: torch.Tensor | None = None) -> ContactBlock:
        """See `Contact`. Where many points touch, ``real`` is the precision, and ``geometric`` (k,) bool as above."""
        compliance = self.compliance[columns] if len(columns) < self.batch else self.compliance
        series = None if self.springs is None else self.springs.series(columns, self.free.shape[1] // 3)
        if self._sums is None and not self._sparse(columns):
            return ContactBlock.of(self.rows(columns), compliance, series, nodes=self.has_friction)
        if self._sums is not None:
            return self._sums.block(columns, self.own_stiffness(columns), self.free[columns], compliance, series)
        own = self._assembled(columns, self.own_stiffness(columns, geometric))
        return ContactBlock.sparse_of(own, compliance, series, nodes=self.has_friction, real=real)
