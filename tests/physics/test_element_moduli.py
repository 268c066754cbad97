"""The stiffness of an element of several moduli."""

import numpy as np
import pytest
from element_body import SIZE, E, tet

from vsfsim.physics.laws.law import lame


def test_an_element_of_two_moduli_has_one_pressure(block):
    """The mean part of a mixed element: pressures equal, volume changes add up, so moduli combine harmonically."""
    made, = block(SIZE, 0.03, young_modulus=lambda x: E * np.array([1.0, 2.0, 4.0, 8.0])[None] * np.ones(x.shape[:2]),
                  poisson_ratio=0.49,
                  elements=tet(0.0)).blocks
    lam = float(lame(E, 0.49)[1])
    assert made.parameters["mean_lam"] == pytest.approx(lam * 4.0 / (1.0 + 0.5 + 0.25 + 0.125), rel=1e-12)
