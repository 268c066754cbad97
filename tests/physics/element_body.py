"""A small body of one kind of element, and its energy, forces and tangent at given displacements."""

import dataclasses

import numpy as np
import warp as wp

from vsfsim.core.material import Foam
from vsfsim.physics.elements import tet10
from vsfsim.physics.laws.law import lame
from vsfsim.physics.solve.elasticity import Elasticity

SIZE = (0.02, 0.03, 0.025)
"""Edges of the block [m]."""
E = 2e4
"""Young's modulus of the block [Pa]."""


def tet(pointwise):
    """Quadratic tetrahedra, with so much of lambda at the Gauss points (in units of mu) and the rest in the element's
    mean volume."""
    def make(mesh, young_modulus, poisson_ratio):
        return (tet10.block(mesh.tets, mesh.gradients, mesh.weights, *lame(young_modulus, poisson_ratio),
                            pointwise=pointwise),)

    return make


FOAM = Foam((0.7 * E, 0.1 * E), (3.0, -1.5), (0.4, 0.1))
"""A foam of two terms whose stiffness changes moderately with strain."""


class Body:
    """A model without supports, and its elements for a batch of displacement fields."""

    def __init__(self, model, device):
        self.model = dataclasses.replace(model, free=np.ones_like(model.free))
        self.elements, self.device = Elasticity(self.model, device=device), device
        self.points = model.mesh.points

    def index(self, columns):
        return wp.array(np.asarray(columns), dtype=wp.int32, device=self.device)

    def put(self, u):
        return wp.array(u, dtype=wp.float64, device=self.device)

    def __call__(self, u):
        """Forces (3 n, B) [N], energy (B,) [J], least det F (B,) at u (3 n, B) [m]."""
        self.elements.begin(u.shape[1])
        self.elements.internal.fill_(np.nan)
        self.elements.energy.fill_(np.nan)
        self.elements.forces(self.index(range(u.shape[1])), self.put(u))
        return tuple(a.numpy().astype(float) for a in (self.elements.internal, self.elements.energy,
                                                       self.elements.least_det))

    def tangent_times(self, u, x, *, projected):
        """Tangent at u (3 n,) times x (3 n, k)."""
        index = self.index(range(x.shape[1]))
        self.elements.begin(x.shape[1])
        self.elements.tangent(index, self.put(np.repeat(u[:, None], x.shape[1], axis=1)), projected=projected)
        out = self.put(np.full_like(x, np.nan))
        self.elements.multiply(index, self.put(x), out)
        return out.numpy().astype(float)
