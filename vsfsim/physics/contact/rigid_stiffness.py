"""The stiffness of the contact points of `RigidContact`, on the nodes of the patches."""

from __future__ import annotations

from typing import Any

import torch

from vsfsim.physics.contact.mount import Springs
from vsfsim.physics.contact.patch import at_points, nodal_sums
from vsfsim.physics.contact.stiffness_block import ContactBlock, assembled
from vsfsim.physics.linear.rest_factor import Response


class PointStiffness:
    """Matrices and blocks of the contact points, from their stiffness at the last evaluation."""

    batch: int
    has_friction: bool
    gap: torch.Tensor
    coulomb: torch.Tensor
    response: Response
    yielding: torch.Tensor
    free: torch.Tensor
    springs: Springs | None
    _values: torch.Tensor
    _local: torch.Tensor
    _rows: torch.Tensor
    _geometric: torch.Tensor
    _coupling: torch.Tensor

    def _faces(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Nodes and shape values of the parts of faces of the touches ``columns`` (k,), see `patch.nodal_sums`."""
        return self._local[columns], self._values[columns]

    def places(self, columns: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Vectors at the nodes of the patches (k, s, 3) interpolated to the contact points (k, 6 f, 3)."""
        return at_points(*self._faces(columns), x)

    def nodal_of(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Forces at the contact points (k, 6 f, 3) [N] as forces on the nodes (k, 3 s) [N]."""
        return nodal_sums(*self._faces(columns), force, self.free.shape[1] // 3).flatten(1)

    @property
    def symmetric(self) -> bool:
        """Whether the contact stiffness is symmetric."""
        return not (self.has_friction and bool(self.coulomb.any()))

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> Any:
        """Contact stiffness on the patches (k, 3 s, 3 s) [N/m], a tensor or an operator.

        ``geometric``: the touches whose stiffness has its geometric term (k,) bool; deep inside a body that term is
        large and wrong."""
        own = self.own_stiffness(columns, geometric)
        fixed = assembled(*self._faces(columns), own, self.free[columns])
        if self.springs is None:
            return fixed
        axis = self.springs.axis[columns][:, None, :, None]
        toward, back = (self.nodal_of(columns, (c @ axis)[..., 0]) * self.free[columns] for c in (own, own.mT))
        return self.springs.soften(fixed, toward, back, own, columns)

    def own_stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> torch.Tensor:
        """Stiffness of the contact points (k, 6 f, 3, 3) [N/m]; ``geometric``: see `stiffness`."""
        rows = self._rows[columns]
        own = rows.mT @ rows + self._coupling[columns]
        if geometric is not None:
            own[geometric] += self._geometric[columns[geometric]]
        return own

    def block(self, columns: torch.Tensor) -> ContactBlock:
        """The contact stiffness, ready to be inverted together with the compliance of the object at rest."""
        own = assembled(*self._faces(columns), self.own_stiffness(columns), self.free[columns])
        if not isinstance(own, torch.Tensor):
            touched = torch.zeros((self.batch, self.free.shape[1] // 3), dtype=torch.bool)
            for b, matrix in zip(columns.tolist(), own.matrices, strict=True):
                touched[b, torch.as_tensor(matrix.indices // 3).long()] = True
            self.response.prepare(touched)
        return ContactBlock.of(own, self.yielding[columns] if len(columns) < self.batch else self.yielding,
                               nodes=self.has_friction)
