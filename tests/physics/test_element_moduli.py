"""The stiffness that a user observes on a layered foundation, and that of an element of several moduli."""

import numpy as np
import pytest
from element_body import SIZE, Body, E, tet

from vsfsim.physics.foundation import foundation
from vsfsim.physics.laws.law import confined_modulus, lame


def test_observed_stiffness_of_a_foundation(block, device):
    """Pressed down as a whole, the top of a layered block answers with the layers' confined moduli in series."""
    nu, size = 0.3, (0.03, 0.03, 0.02)
    body = Body(block(size, 0.005, young_modulus=lambda x: np.where(x[..., 2] < 0.01, E, 4.0 * E), poisson_ratio=nu,
                      elements=foundation), device)
    # away from the edges, where normals turn outwards
    inner = (np.abs(body.points[:, 2] - 0.02) < 1e-9) & (np.abs(body.points[:, :2]) < 0.0095).all(axis=1)
    u = np.zeros_like(body.points)
    u[:, 2] = -1e-4
    force = body(u.reshape(-1, 1))[0].reshape(-1, 3)[inner, 2].sum()
    # their part of the surface: 36 of the 6 x 6 squares of 5 mm lie within, shared with the nodes around; count by the
    # shares of a uniform field
    m = confined_modulus(1.0, nu)
    pressure = 1e-4 / (0.01 / (m * E) + 0.01 / (4.0 * m * E))
    stiffness = body.model.blocks[0].parameters["stiffness"]
    share = np.zeros(len(body.points))
    for face, area in zip(body.model.mesh.faces, body.model.mesh.face_area()):
        share[face] += area * np.array([3, 3, 3, 16, 16, 16]) / 57.0
    assert -force == pytest.approx(pressure * share[inner].sum(), rel=1e-3)
    assert share.sum() == pytest.approx(body.model.mesh.face_area().sum(), rel=1e-12)
    assert (stiffness > 0.0).all()
    assert body.model.grounding() == pytest.approx(np.repeat(stiffness, 3))


def test_an_element_of_two_moduli_has_one_pressure(block):
    """The mean part of a mixed element: pressures equal, volume changes add up, so moduli combine harmonically."""
    made, = block(SIZE, 0.03, young_modulus=lambda x: E * np.array([1.0, 2.0, 4.0, 8.0])[None] * np.ones(x.shape[:2]),
                  poisson_ratio=0.49,
                  elements=tet(0.0)).blocks
    lam = float(lame(E, 0.49)[1])
    assert made.parameters["mean_lam"] == pytest.approx(lam * 4.0 / (1.0 + 0.5 + 0.25 + 0.125), rel=1e-12)
