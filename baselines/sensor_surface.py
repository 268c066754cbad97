"""The surface of a deformable sensor in a touch, for methods that use the contact forces on its vertices."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from vsfsim.bench.method import Reading
from vsfsim.core.errors import MethodError
from vsfsim.vsf.fields.line_integrals import SurfaceTouch


def dense_touch(reading: Reading) -> SurfaceTouch | None:
    """The frames of a touch in which the surface was reconstructed, with the force on its vertices.

    The force is NaN in a frame without a reading of it. The triangles are those of the Delaunay triangulation over the
    rim's plane, wound outwards.

    Returns:
        None if no frame after the first reconstructed one has a force.

    Raises:
        MethodError: vertices and forces do not fit each other, or a frame has some of the forces only.
    """
    assert reading.surface is not None
    vertices, force = (np.asarray(x, float) for x in (reading.surface.vertices, reading.surface.force))
    if vertices.ndim != 3 or vertices.shape != force.shape or vertices.shape[2] != 3:
        raise MethodError(f"the sensor's surface has vertices {vertices.shape} and forces {force.shape}; both must "
                          f"be (T, N, 3).")
    whole = np.isfinite(vertices).all(axis=(1, 2))
    force = np.where(reading.valid[:, None, None], force, np.nan)[whole]
    known = ~np.isnan(force).all(axis=(1, 2))
    if not np.isfinite(force[known]).all():
        raise MethodError("a force on the sensor's surface is not finite in a frame that has others; leave the "
                          "whole frame out.")
    if not known[1:].any():
        return None
    first = int(np.argmax(whole))
    pose = reading.action.poses[first]
    local = (vertices[first] - pose[:3, 3]) @ pose[:3, :3]
    corners = Delaunay(local[:, :2]).simplices
    a, b, c = (local[corners[:, k], :2] for k in range(3))
    inwards = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0] < 0.0
    return SurfaceTouch(vertices[whole], np.where(inwards[:, None], corners[:, ::-1], corners), force)
