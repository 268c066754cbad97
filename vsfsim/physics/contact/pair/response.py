"""How an object and a sensor, each at rest, respond to the forces between their surfaces."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model

SENSOR_NODES = 3000
"""Largest number of nodes m of a sensor that touches an object: its compliance is kept whole, (3 m)^2 doubles."""


class PairResponse:
    """Rest-state response of both bodies of B touches; N are the nodes of both.

    Args:
        model: the object.
        sensor: the body with the touching surface.
        dof: degrees of freedom of the object's nodes in reach of each touch (B, 3 s); those of the sensor follow.
        device: Warp device.
    """

    resident = False

    def __init__(self, model: Model, sensor: Model, dof: torch.Tensor, *, device: str):
        self.device, self.sensor = device, sensor
        self._rows, self._split = 3 * len(model.mesh.points), dof.shape[1]
        inverse = sensor.factor.solve(np.diag(sensor.free))
        self._sensor_compliance = torch.as_tensor(0.5 * (inverse + inverse.T), device=self.device)
        self._object: Response = response(model.preconditioner, dof, device=device)

    def between(self, touches: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
        """See `rest_factor.Response`; bodies do not move one another."""
        sensor, there = dof >= self._split, (dof - self._split).clamp(min=0)
        here = torch.where(sensor, dof[:, :1].clamp(max=self._split - 1), dof)  # the object's dof come first
        return torch.where(sensor[:, :, None] & sensor[:, None], self._sensor_compliance[
            there[:, :, None], there[:, None]], torch.where(
                sensor[:, :, None] | sensor[:, None], 0.0, self._object.between(touches, here)))

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] under forces (3 N, k) [N] that are 0 where held."""
        return torch.cat([self._object.solve(right[:self._rows].contiguous()), self._sensor_solve(right[self._rows:])])

    def _sensor_solve(self, right: torch.Tensor) -> torch.Tensor:
        if self.device == "cpu":
            return torch.as_tensor(self.sensor.factor.apply(right.contiguous().numpy()))
        return self._sensor_compliance @ right

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] under forces (k, 3 s) [N] on the surface nodes of ``touches`` (k,)."""
        return torch.cat([self._object.patch(touches, force[:, :self._split]),
                          self._sensor_solve(force[:, self._split:].T)])
