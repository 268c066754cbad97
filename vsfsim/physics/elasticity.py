"""The elements of a body on the device: forces, energy, tangent products, for the columns of a batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements import tet10
from vsfsim.physics.model import Model


class Elasticity:
    """Device arrays of one model and one batch of touches. Everything stays on the device; nothing is read back here.

    internal: nodal forces (3 n, B) [N], energy: elastic energy (B,) [J], least_det: least det F (B,) [-]; the columns of the last
    `forces` are renewed, the others stay as they were.

    Args:
        model: the body. device: Warp device. real: `wp.float32` or `wp.float64`.
    """

    def __init__(self, model: Model, *, device: str, real: type):
        self.device, self.real = device, real
        self.kernels = tet10.kernels(real)
        mesh = model.mesh

        def put(values: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        self._tets, self._points = len(mesh.tets), len(mesh.points)
        self._nodes = put(mesh.tets, wp.int32)
        self._gradients = put(mesh.gradients, self.kernels.mat43)
        self._volume = put(mesh.volume, real)
        self._mu, self._lam = put(model.mu, real), put(model.lam, real)
        order = np.argsort(mesh.tets.ravel(), kind="stable").astype(np.int32)
        count = np.bincount(mesh.tets.ravel(), minlength=self._points)
        self._start = put(np.concatenate([[0], np.cumsum(count)]), wp.int32)
        self._slot = put(order, wp.int32)
        self._free = put(model.free, real)
        self._every = put(np.ones_like(model.free), real)

    def begin(self, batch: int) -> None:
        """Room for ``batch`` touches."""
        k, new = self.kernels, {"device": self.device}
        self._force = wp.zeros((self._tets, 10, batch), dtype=k.vec3, **new)
        self._hessian = wp.zeros((self._tets, 4, batch), dtype=k.mat99, **new)
        self._tet_energy = wp.zeros((self._tets, batch), dtype=self.real, **new)
        self._tet_det = wp.zeros((self._tets, batch), dtype=self.real, **new)
        self.internal = wp.zeros((3 * self._points, batch), dtype=self.real, **new)
        self.energy = wp.zeros(batch, dtype=wp.float64, **new)
        self.least_det = wp.zeros(batch, dtype=self.real, **new)

    def _launch(self, index: wp.array, u: wp.array, hessian: int) -> None:
        wp.launch(self.kernels.evaluate, dim=(self._tets, len(index)), device=self.device, inputs=[
            self._nodes, self._gradients, self._volume, self._mu, self._lam, hessian, index, u,
            self._force, self._tet_energy, self._tet_det, self._hessian])

    def forces(self, index: wp.array, u: wp.array) -> None:
        """Renew `internal`, `energy` and `least_det` of the columns ``index`` (k,) int32 for displacements u (3 n, B) [m]."""
        self._launch(index, u, 0)
        wp.launch(self.kernels.gather, dim=(self._points, len(index)), device=self.device,
                  inputs=[self._start, self._slot, self._every, index, 0, self._force, self.internal])
        wp.launch(self.kernels.summarise, dim=len(index), device=self.device,
                  inputs=[index, self._tet_energy, self._tet_det, self.energy, self.least_det])

    def tangent(self, index: wp.array, u: wp.array, *, projected: bool) -> None:
        """Make the tangent of the columns ``index`` (k,) at u (3 n, B), projected to positive semi-definite or as it is."""
        self._launch(index, u, 1 if projected else 2)

    def multiply(self, index: wp.array, x: wp.array) -> wp.array:
        """Tangent times x (3 n, k) [m]: column j belongs to touch ``index[j]``; rows of held degrees of freedom are 0."""
        out = wp.empty_like(x)
        wp.launch(self.kernels.multiply, dim=(self._tets, len(index)), device=self.device,
                  inputs=[self._nodes, self._gradients, index, self._hessian, x, self._force])
        wp.launch(self.kernels.gather, dim=(self._points, len(index)), device=self.device,
                  inputs=[self._start, self._slot, self._free, index, 1, self._force, out])
        return out
