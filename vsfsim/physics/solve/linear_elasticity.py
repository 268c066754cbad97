"""Linear elasticity of the rest state, for the same loop: the elements of the `linear` tier and of `vsf`."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.physics.linear.cholesky import Order, blocks_of
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity


class LinearElasticity(Elasticity):
    """As `Elasticity`, with the forces K u, K the stiffness at rest, which is the tangent of every state."""

    def __init__(self, model: Model, *, device: str):
        super().__init__(model, device=device)
        self._factor = model.factor
        self._held = torch.as_tensor(model.free, device=device)[:, None]

    def _times(self, u: torch.Tensor) -> torch.Tensor:
        if self.device == "cpu":
            return torch.as_tensor(self._factor.stiffness @ u.numpy())
        return self._factor.stiffness_on(self.device) @ u

    def forces(self, index: wp.array, u: wp.array) -> None:
        """See `Elasticity`; small strain has no det F, which is 1."""
        at = wp.to_torch(index).long()
        moved = wp.to_torch(u)[:, at]
        force = self._times(moved)
        wp.to_torch(self.internal)[:, at] = force
        wp.to_torch(self.energy)[at] = 0.5 * (moved * force).sum(dim=0)
        wp.to_torch(self.least_det)[at] = 1.0

    def det(self, index: wp.array, u: wp.array) -> torch.Tensor:
        """The least det F that the elements have at displacements u (3 n, B) [m], of the touches ``index`` (k,) [-]."""
        super().forces(index, u)
        out = wp.to_torch(self.least_det)[wp.to_torch(index).long()]
        self.forces(index, u)
        return out

    def tangent(self, index: wp.array, u: wp.array, *, projected: bool) -> None:
        """It is always there."""

    def multiply(self, index: wp.array, x: wp.array, out: wp.array) -> None:
        """See `Elasticity`."""
        wp.to_torch(out).copy_(self._times(wp.to_torch(x)) * self._held)

    def add_matrices(self, touch: int, order: Order, values: np.ndarray) -> None:
        """See `Elasticity`."""
        blocks = blocks_of(self._factor.stiffness)
        owners = np.repeat(np.arange(len(blocks.indptr) - 1), np.diff(blocks.indptr))
        values[order.find(owners, blocks.indices)] += blocks.data
