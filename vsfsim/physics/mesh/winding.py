"""The generalised winding number of a triangle surface."""

from __future__ import annotations

import numpy as np

_PAIRS = 2_000_000  # points times triangles at once


def winding_number(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Winding number (k,) of ``points`` (k, 3): 1 inside a simple solid, 0 outside, between for a surface with holes.

    It is the sum of the solid angles of all triangles over 4 pi (Van Oosterom and Strackee 1983), exact and slow.

    Args:
        vertices: corners (n, 3) [m].
        faces: triangles (f, 3), wound outwards.
        points: places (k, 3) [m].
    """
    out = np.empty(len(points))
    chunk = max(1, _PAIRS // len(faces))
    for start in range(0, len(points), chunk):
        part = points[start:start + chunk]
        a, b, c = (vertices[faces[:, k]][None] - part[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        top = np.einsum("pfc,pfc->pf", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("pfc,pfc->pf", u, v) for u, v in ((a, b), (b, c), (c, a)))
        bottom = la * lb * lc + ab * lc + bc * la + ca * lb
        out[start:start + len(part)] = 2.0 * np.arctan2(top, bottom).sum(axis=1) / (4.0 * np.pi)
    return out
