"""A law of a solid material, which any solid element takes.

A law is one file: what it says on the host, and Warp functions at one point of a body. A package adds one as an entry
point of the group ``vsfsim.laws``, a `SolidLaw`; a scene names it in ``[object] law``.

``functions(module)`` is an object with three Warp functions in double precision, compiled into ``module``. The arrays
``own`` (m, 4, p) and ``terms`` (r, c) hold what `SolidLaw.parameters` gives; t is the element and q the point. D is a
displacement gradient, F = 1 + D, J = det F, and ``push`` a pressure that the element adds to dPsi/dJ [Pa].

    respond(d, own, terms, t, q, push)       energy density without push [J/m^3], J, and the first Piola-Kirchhoff
                                             stress (3 x 3) [Pa]
    linearise(d, own, terms, t, q, b, push, projected, state_out)
                                             writes the tangent of touch b to the rows stored q to stored (q + 1) - 1 of
                                             state_out[t]; positive semi-definite if projected is 1
    multiply(d, x, own, t, q, b, state_in)   that tangent times the displacement gradient x (3 x 3) [Pa]

A law in terms of principal stretches needs no more than its energy and two derivatives, see `principal.functions_of`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Settings = Mapping[str, Sequence[float]]
"""What a scene gives beside a law's name: each a row of numbers."""
MOST_POISSON_RATIO = 0.45
"""Of a law that acts at the points alone: there an element with lambda at every point is 0.4 % too stiff on S1."""


@dataclass(frozen=True)
class SolidLaw:
    """One law."""

    name: str
    """By which scenes and entry points name it; also part of the name of its kernels' module."""
    stored: int
    """Numbers that a tangent stores at a point."""
    functions: Callable[[str], Any]
    """See the head of this file."""
    parameters: Callable[[np.ndarray, np.ndarray, Settings], tuple[np.ndarray, np.ndarray]]
    """Own numbers of every point (m, 4, p) and shared terms (r, c), from mu and lambda (m, 4) [Pa], which the law must
    have at small strain."""
    settings: tuple[str, ...] = ()
    """Names of the rows of numbers that it takes, all of them."""
    pressed: bool = False
    """Whether its functions add ``push``: then most of a large lambda acts on an element's mean volume, which a nearly
    incompressible body needs, and otherwise Poisson's ratio is at most `MOST_POISSON_RATIO`."""


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
