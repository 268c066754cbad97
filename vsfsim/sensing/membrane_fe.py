"""The skin of a bubble on its read-out mesh of linear triangles: areas, normals, and the forces that hold it."""

from __future__ import annotations

import numpy as np
import warp as wp

from vsfsim.core.errors import VsfsimError
from vsfsim.physics.elements import triangle


class SensorError(VsfsimError):
    """An invalid mesh, state or parameter of a bubble."""


def checked_mesh(points: np.ndarray, triangles: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) [m] and triangles (m, 3) as float64 and int64.

    Raises:
        SensorError: a wrong shape, a point that is not finite, an index out of range, or a triangle without area.
    """
    points, triangles = np.asarray(points, np.float64), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise SensorError(f"{where}: points have shape {points.shape}; give finite positions (n, 3) in metres.")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0 or triangles.dtype.kind not in "iu":
        raise SensorError(f"{where}: triangles have shape {triangles.shape} and dtype {triangles.dtype}; give whole "
                          f"numbers (m, 3), m >= 1.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise SensorError(f"{where}: a triangle names point {int(triangles.max())} of {len(points)}; indices go from 0 "
                          f"to {len(points) - 1}.")
    flat = np.flatnonzero(np.linalg.norm(area_vectors(points, triangles), axis=1) <= 0.0)
    if len(flat):
        raise SensorError(f"{where}: triangle {int(flat[0])} has no area; remove it or mend the mesh.")
    return points, triangles.astype(np.int64)


def area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area times unit normal of each triangle (m, 3) [m^2]; points (n, 3) [m]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def nodal_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area vectors around each node (n, 3) [m^2]: times a pressure it is the air's force on the node."""
    out = np.zeros_like(points)
    np.add.at(out, triangles, area_vectors(points, triangles)[:, None, :] / 3.0)
    return out


def nodal_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Outward unit normal at each node (n, 3), weighted by area."""
    area = nodal_areas(points, triangles)
    return area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)


def in_their_planes(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Corners (m, 3, 2) [m] of triangles, each in a plane of its own: the rest shapes of a skin that is free of stress
    at ``points`` (n, 3) [m]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    along = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    across = np.cross(area_vectors(points, triangles), along)
    axes = np.stack([along, across / np.linalg.norm(across, axis=1, keepdims=True)], axis=2)
    return np.stack([a - a, b - a, c - a], axis=1) @ axes


def skin_forces(points: np.ndarray, triangles: np.ndarray, rest: np.ndarray, stiffness: float) -> np.ndarray:
    """Forces (n, 3) [N] that hold the nodes of a skin of `vsfsim.physics.elements.triangle` at ``points`` (n, 3) [m].

    Args:
        triangles: (m, 3). rest: their stress-free corners (m, 3, 2) [m]. stiffness: E h [N/m].

    Raises:
        SensorError: a triangle has no area.
    """
    checked_mesh(points, triangles, "membrane")
    count, block = len(triangles), triangle.block(triangles, points, rest, stiffness)
    force, energy, det = (wp.zeros(shape, dtype=wp.float64, device="cpu")
                          for shape in ((count, 9, 1), (count, 1), (count, 1)))
    wp.launch(block.kernels().forces, dim=(count, 1), device="cpu", inputs=[
        block.arguments("cpu"), wp.zeros(1, dtype=wp.int32, device="cpu"),
        wp.zeros((3 * len(points), 1), dtype=wp.float64, device="cpu"), force, energy, det])
    out = np.zeros_like(points)
    np.add.at(out, triangles, force.numpy().reshape(count, 3, 3))
    return out
