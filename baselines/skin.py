"""The skin of a soft sensor in a touch, for methods that read the contact forces on its vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from vsfsim.bench.method import Reading
from vsfsim.core.errors import MethodError
from vsfsim.vsf.fields.palpation import DenseTouch


def skin_touch(reading: Reading) -> DenseTouch | None:
    """The frames of a touch in which the skin was seen, with the force on its vertices (NaN where there is no reading
    of them); None if it was seen in fewer than two, or with no force behind the first of them.

    The triangles are those of the Delaunay triangulation over the rim's plane, wound outwards.

    Raises:
        MethodError: vertices and forces do not fit each other, or a frame has some of the forces only.
    """
    assert reading.surface is not None
    vertices, force = (np.asarray(x, float) for x in (reading.surface.vertices, reading.surface.force))
    if vertices.ndim != 3 or vertices.shape != force.shape or vertices.shape[2] != 3:
        raise MethodError(f"the sensor's surface has vertices {vertices.shape} and forces {force.shape}; both must "
                          f"be (T, N, 3).")
    seen = np.isfinite(vertices).all(axis=(1, 2))
    force = np.where(reading.valid[:, None, None], force, np.nan)[seen]
    known = ~np.isnan(force).all(axis=(1, 2))
    if not np.isfinite(force[known]).all():
        raise MethodError("a force on the sensor's surface is not finite in a frame that has others; leave the "
                          "whole frame out.")
    if not known[1:].any():
        return None
    first = int(np.argmax(seen))
    pose = reading.action.poses[first]
    local = (vertices[first] - pose[:3, 3]) @ pose[:3, :3]
    corners = Delaunay(local[:, :2]).simplices
    a, b, c = (local[corners[:, k], :2] for k in range(3))
    turned = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] < 0.0
    return DenseTouch(vertices[seen], np.where(turned[:, None], corners[:, ::-1], corners), force)
