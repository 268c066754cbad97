"""The exact rod that leans on a bar: where it must still be held, and with what force."""

from __future__ import annotations

import numpy as np

MOST = 1.5
"""Lean at the bar up to which the plane equilibrium is looked at [rad]; a frictionless stem that leans further may slip
sideways."""


def elastica(height: float, reach: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """An inextensible stem, clamped upright at its foot, that leans on a frictionless bar at a fixed height: the
    elastica under a force across its end, to a lean of `MOST` there.

    With phi the angle to the end's tangent, phi'^2 = 2 F sin(phi) / (E I), and the end is where the bar is. All shapes
    of one lean are similar, so lean and height give the length in use, which is the stem's when it slips off.

    Args:
        height: of the bar's axis [m].
        reach: radius of the bar and of the stem together [m].
        length: of the stem [m].

    Returns:
        Way of the bar's axis from the foot (k,) [m], increasing, to where the stem slips off over its end; and the
        force on the bar over the stem's bending stiffness (k,) [1/m^2].
    """
    points, weights = np.polynomial.legendre.leggauss(60)
    out = []
    for lean in np.linspace(0.02, MOST, 300):
        u = 0.5 * np.sqrt(lean) * (points + 1.0)  # phi = u^2 takes the root out of the integrals
        d = np.sqrt(lean) * weights * u / np.sqrt(np.sin(u**2))
        size, across, up = d.sum(), d @ np.sin(lean - u**2), d @ np.cos(lean - u**2)
        used = (height - reach * np.sin(lean)) * size / up
        if used > length:
            break
        if used > 0.0:  # a bar lower than its radius meets the foot
            out.append((used * across / size - reach * np.cos(lean), 0.5 * (size / used) ** 2))
    way, force = np.array(out).reshape(-1, 2).T
    return way, force
