"""Triangles of rigid shapes, to draw them."""

from __future__ import annotations

import math

import numpy as np

from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf

SIDES = 48  # of a round shape


def tessellate(shape: ProbeShape, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) [m] and triangles (g, 3) of a rigid shape in its own frame; a plane is a square plate of edge
    ``size`` [m]."""
    match shape:
        case MeshFile():
            grid = sdf.grid(shape)
            return grid.vertices, grid.faces
        case Box(edges):
            return _box(0.5 * np.array(edges), -0.5 * np.array(edges))
        case Plane():
            half = 0.5 * size
            return _box(np.array([half, half, 0.0]), np.array([-half, -half, -0.02 * size]))
        case Sphere(radius):
            angle = np.linspace(0.0, math.pi, SIDES // 2 + 1)
            return _revolved(radius * np.sin(angle), -radius * np.cos(angle))
        case Capsule(radius, length):
            angle = np.linspace(0.0, math.pi, SIDES // 2 + 2)
            lift = 0.5 * length * np.where(angle < 0.5 * math.pi, -1.0, 1.0)
            return _revolved(radius * np.sin(angle), lift - radius * np.cos(angle))
        case Cylinder(radius, height):
            return _revolved(np.array([0.0, radius, radius, 0.0]), 0.5 * height * np.array([-1.0, -1.0, 1.0, 1.0]))
    raise AssertionError(shape)


def _box(high: np.ndarray, low: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from trimesh.creation import box  # inside: a dataset draws nothing

    mesh = box(bounds=[low, high])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def _revolved(radius: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface of revolution about z of a profile from bottom to top."""
    from trimesh.creation import revolve

    scale = float(radius.max())  # trimesh leaves out triangles of 1e-8 square units
    mesh = revolve(np.column_stack([radius, height]) / scale, sections=SIDES)
    return scale * np.asarray(mesh.vertices), np.asarray(mesh.faces)
