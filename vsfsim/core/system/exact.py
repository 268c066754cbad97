"""Numbers that every kind of CPU gives alike.

BLAS and LAPACK choose their kernels by the CPU, and these add in another order or fuse a product with a sum, so that
the last bits of a dot product, a matrix product, an inverse or a norm of one vector differ. Where such a number decides
what a solver does, it is computed here in a fixed order by elementwise operations, which IEEE 754 fixes to the bit, or
its last bits are rounded away.
"""

from __future__ import annotations

import math

import numpy as np

BITS = 30
"""Of a number that `snapped` keeps: 1e-9 of it. Two numbers that differ in their last bits, by 1e-15 say, are rounded
apart once in a million times."""


def snapped(values: np.ndarray) -> np.ndarray:
    """Each value rounded to its first `BITS` bits."""
    part, power = np.frexp(np.asarray(values, np.float64))
    return np.ldexp(np.rint(np.ldexp(part, BITS)), power - BITS)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a @ b`` of stacks of small matrices (..., i, k), (..., k, j), each sum from the first term to the last."""
    out = a[..., :, :1] * b[..., :1, :]
    for k in range(1, a.shape[-1]):
        out = out + a[..., :, k:k + 1] * b[..., k:k + 1, :]
    return out


def length(vector: np.ndarray) -> float:
    """Norm of one vector (3,)."""
    x, y, z = map(float, vector)
    return math.sqrt(x * x + y * y + z * z)


def inverse3(matrices: np.ndarray) -> np.ndarray:
    """Inverses of a stack of matrices (..., 3, 3), by their cofactors; infinite or NaN where one is singular."""
    a, b, c = (matrices[..., k, :] for k in range(3))
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    det = a[..., 0] * rows[..., 0, 0] + a[..., 1] * rows[..., 1, 0] + a[..., 2] * rows[..., 2, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return rows / det[..., None, None]
