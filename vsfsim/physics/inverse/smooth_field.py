"""A smooth random field over the elements of a body, by few coefficients."""

from __future__ import annotations

import numpy as np

_CENTRES = 60  # places whose values decide those of all others


def smooth_basis(places: np.ndarray, *, reach: float, std: float) -> np.ndarray:
    """Functions (n, c) whose sums with standard normal coefficients are a Gaussian process with the covariance
    std^2 exp(-r^2 / 2 reach^2), as the values at a few places far from one another tell it (Nystroem's method,
    Williams and Seeger 2001).

    Args:
        places: where its values are asked (n, 3) [m].
        reach: over which they are alike [m].
        std: deviation of each.
    """
    centres = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmin())]
    away = np.linalg.norm(places - places[centres[0]], axis=1)
    while len(centres) < min(_CENTRES, len(places)) and away.max() > 0.5 * reach:
        centres.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[centres[-1]], axis=1))
    chosen = places[centres]

    def alike(a: np.ndarray) -> np.ndarray:
        square = ((a[:, None] - chosen[None]) ** 2).sum(axis=2)
        return std**2 * np.exp(-0.5 * square / reach**2)

    value, vector = np.linalg.eigh(alike(chosen))
    keep = value > 1e-6 * value[-1]
    return alike(places) @ (vector[:, keep] / np.sqrt(value[keep]))
