"""The one place where (E, nu) becomes an element's coefficients."""

from __future__ import annotations

import numpy as np


def lame(young_modulus: np.ndarray | float, poisson_ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Lamé's constants of linear elasticity.

    Args:
        young_modulus: E [Pa], any shape.
        poisson_ratio: nu, 0 <= nu < 0.5.

    Returns:
        (mu, lambda) [Pa], of the shape of E.
    """
    e = np.asarray(young_modulus, float)
    return e / (2.0 * (1.0 + poisson_ratio)), e * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))


def confined_modulus(young_modulus: np.ndarray | float, poisson_ratio: float) -> np.ndarray:
    """Stress over strain of a layer that cannot move sideways, M = E (1 - nu) / ((1 + nu) (1 - 2 nu)) [Pa].

    Over its thickness h it is the modulus of an elastic foundation, pressure = (M / h) displacement (Johnson 1985,
    section 4.3:
    a compressible layer, bonded below and much thinner than the contact is wide).
    """
    mu, lam = lame(young_modulus, poisson_ratio)
    return lam + 2.0 * mu
