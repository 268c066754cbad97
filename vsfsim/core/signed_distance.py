"""Signed distances to the analytic shapes in NumPy, for all host code; negative inside.

The kernels' twin is `vsfsim.physics.contact.sdf`, which also knows meshes. A probe's origin is its centre; that of a
`Plane` is on its surface.
"""

from __future__ import annotations

import numpy as np

from vsfsim.core.dome import Dome
from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, Sphere

Analytic = Sphere | Capsule | Cylinder | Box | Plane


def distance(shape: Analytic, points: np.ndarray, *, fillet: float = 0.0) -> np.ndarray:
    """Signed distance (...,) [m] to a shape.

    Args:
        shape: the shape in its own frame.
        points: places (..., 3) [m] in that frame.
        fillet: radius of the rounded edges of a cylinder or a box [m].
    """
    x = np.asarray(points, float)
    match shape:
        case Plane():
            return x[..., 2]
        case Sphere(radius):
            return np.linalg.norm(x, axis=-1) - radius
        case Capsule(radius, length):
            axial = x[..., 2] - np.clip(x[..., 2], -0.5 * length, 0.5 * length)
            return np.sqrt(x[..., 0] ** 2 + x[..., 1] ** 2 + axial**2) - radius
        case Cylinder(radius, height):
            q = np.stack([np.hypot(x[..., 0], x[..., 1]) - radius, np.abs(x[..., 2]) - 0.5 * height], axis=-1) + fillet
        case Box(size):
            q = np.abs(x) - 0.5 * np.asarray(size) + fillet
        case _:
            raise AssertionError(shape)
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0) - fillet


def segment_distance(points: np.ndarray, start: np.ndarray, stop: np.ndarray) -> np.ndarray:
    """Distance (...,) [m] of ``points`` (..., 3) from the segment between two points (3,) [m]."""
    axis = np.subtract(stop, start)
    t = np.clip((points - start) @ axis / max(float(axis @ axis), 1e-30), 0.0, 1.0)
    return np.linalg.norm(points - start - t[..., None] * axis, axis=-1)


def reach(shape: Analytic | Dome) -> float:
    """Radius of the smallest ball about the origin that holds a shape [m]; infinite for a plane."""
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, length):
            return radius + 0.5 * length
        case Cylinder(radius, height):
            return float(np.hypot(radius, 0.5 * height))
        case Box(size):
            return 0.5 * float(np.linalg.norm(size))
        case Dome():
            return shape.reach
        case Plane():
            return float("inf")
    raise AssertionError(shape)


def support(shape: Analytic, direction: np.ndarray) -> float:
    """How far a shape extends from its origin along a unit ``direction`` (3,) of its own frame [m]."""
    d = np.abs(np.asarray(direction, float))
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, length):
            return radius + 0.5 * length * float(d[2])
        case Cylinder(radius, height):
            return radius * float(np.hypot(d[0], d[1])) + 0.5 * height * float(d[2])
        case Box(size):
            return 0.5 * float(np.dot(size, d))
        case Plane():
            return 0.0
    raise AssertionError(shape)
