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


# A network of springs k, L with directions n in a volume V stores, at a uniform strain e, sum k L^2 (n.e.n)^2 / 2: its
# elasticity is C = (1/V) sum k L^2 n n n n, symmetric in all four indices. An isotropic one has
# C_iiii = lambda + 2 mu, C_iijj = lambda and C_ijij = mu, and the symmetry makes lambda = mu, i.e. nu = 1/4.
# With E = mu (3 lambda + 2 mu) / (lambda + mu) = 5/2 mu:   C_nnnn = 3 mu = 6/5 E   and   sum k L^2 / V = 15 mu = 6 E;
# shared equally by a tetrahedron's six edges that is Van Gelder 1998, k = E V / L^2.

SPRING_ALONG = 6.0 / 5.0  # C_nnnn / E of an isotropic network of springs
