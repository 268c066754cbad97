"""How an object and a sensor, each at rest, respond to the forces between their surfaces."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.contact.pair.links import Compliance
from vsfsim.physics.contact.pair.surfaces import PairPatch, PairSurfaces
from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model

_TABLE = 1500  # unknowns of a sensor up to which its whole inverse responds faster on a CPU than its factor
SENSOR_NODES = 3000
"""Largest number of nodes m of a sensor that touches an object: its compliance is kept whole, (3 m)^2 doubles."""


class PairResponse:
    """Rest-state response of both bodies of B touches; N are the nodes of both.

    Args:
        model: the object.
        sensor: the body with the touching surface.
        surfaces: the surfaces of both.
    """

    resident = False

    def __init__(self, model: Model, sensor: Model, surfaces: PairSurfaces):
        self.device, self.sensor, self._surfaces = surfaces.device, sensor, surfaces
        self._rows = 3 * len(model.mesh.points)
        inverse = sensor.factor.solve(np.diag(sensor.free))
        self._sensor_compliance = torch.as_tensor(0.5 * (inverse + inverse.T), device=self.device)
        self._sensor_single = self._sensor_compliance.to(torch.float32)
        dof = surfaces.dof[:, :surfaces.width].reshape(surfaces.batch, -1)
        self._object: Response = response(model.preconditioner, dof, device=self.device)
        self._object_compliance = self._object.compliance()

    @property
    def took(self) -> float:
        """Time of the object's last `Response.solve` [s]."""
        return self._object.took

    @property
    def _patch(self) -> PairPatch:
        return self._surfaces.patch

    def compliance(self) -> Compliance:
        """Compliance of the present patches."""
        surfaces, patch = self._surfaces, self._patch
        if self._object.prepare(surfaces.near[:, :surfaces.width] > 0):
            self._object_compliance = self._object.compliance()
        split, free = 3 * patch.split, patch.free
        rows = torch.arange(surfaces.batch, device=self.device)[:, None, None]
        a, c = patch.on_object, patch.on_sensor
        on_object = self._object_compliance[rows, a[:, :, None], a[:, None, :]]
        on_sensor = self._sensor_compliance[c[:, :, None], c[:, None, :]]
        return Compliance(on_object * free[:, :split, None] * free[:, None, :split],
                          on_sensor * free[:, split:, None] * free[:, None, split:])

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] under forces (3 N, k) [N] that are 0 where held."""
        return torch.cat([self._object.solve(right[:self._rows].contiguous()), self._sensor_solve(right[self._rows:])])

    def _sensor_solve(self, right: torch.Tensor) -> torch.Tensor:
        if self.device == "cpu" and len(right) > _TABLE:
            return torch.as_tensor(self.sensor.factor.solve(right.contiguous().numpy()))
        if self.device == "cpu":
            # in single precision there are half the bytes to read, and the iterations correct the result
            return (self._sensor_single @ right.to(torch.float32)).to(right.dtype)
        return self._sensor_compliance @ right

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Displacements (3 N, k) [m] under forces (k, 3 s) [N] on the patches of ``touches`` (k,)."""
        patch = self._patch
        split = 3 * patch.split
        force = force * patch.mask[touches]
        on_object = torch.zeros((len(touches), 3 * self._surfaces.width), dtype=force.dtype, device=self.device)
        on_object.scatter_add_(1, patch.on_object[touches], force[:, :split])
        return torch.cat([self._object.patch(touches, on_object),
                          self._sensor_patch(patch.on_sensor[touches], force[:, split:])])

    def _sensor_patch(self, at: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """The sensor's part of `patch`, for forces (k, 3 c) [N] on its degrees of freedom ``at`` (k, 3 c)."""
        if self.device == "cpu" and len(self._sensor_single) <= _TABLE:
            # as `_sensor_solve`, and only the rows of the patch are read
            single = force.to(torch.float32)
            return torch.stack([f @ self._sensor_single[rows] for f, rows in zip(single, at, strict=True)],
                               dim=1).to(force.dtype)
        whole = torch.zeros((len(at), len(self._sensor_compliance)), dtype=force.dtype, device=self.device)
        return self._sensor_solve(whole.scatter_add_(1, at, force).T)
