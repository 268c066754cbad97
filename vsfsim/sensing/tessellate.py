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
    half = 0.5 * size
    match shape:
        case MeshFile():
            grid = sdf.grid(shape)
            return grid.vertices, grid.faces
        case Box(edges):
            return _block(*(0.5 * e for e in edges))
        case Plane():
            vertices, faces = _block(half, half, 0.01 * size)
            return vertices - [0.0, 0.0, 0.01 * size], faces
        case Sphere(radius):
            angle = np.linspace(0.0, math.pi, SIDES // 2 + 1)
            return _revolved(radius * np.sin(angle), radius * np.cos(angle))
        case Capsule(radius, length):
            angle = np.linspace(0.0, math.pi, SIDES // 2 + 2)
            lift = 0.5 * length * np.where(angle < 0.5 * math.pi, 1.0, -1.0)
            return _revolved(radius * np.sin(angle), radius * np.cos(angle) + lift)
        case Cylinder(radius, height):
            return _revolved(np.array([0.0, radius, radius, 0.0]), 0.5 * height * np.array([1.0, 1.0, -1.0, -1.0]))
    raise AssertionError(shape)


def _block(x: float, y: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _revolved(radius: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The surface of revolution about z of a profile from top to bottom."""
    turn = 2.0 * math.pi * np.arange(SIDES) / SIDES
    vertices = np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn)),
                         np.repeat(height[:, None], SIDES, axis=1)], axis=-1).reshape(-1, 3)
    i, k = np.meshgrid(np.arange(len(radius) - 1), np.arange(SIDES), indexing="ij")
    a, b = i * SIDES + k, i * SIDES + (k + 1) % SIDES
    faces = np.concatenate([np.stack([a, a + SIDES, b + SIDES], axis=-1).reshape(-1, 3),
                            np.stack([a, b + SIDES, b], axis=-1).reshape(-1, 3)])
    size = np.linalg.norm(np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                                   vertices[faces[:, 2]] - vertices[faces[:, 0]]), axis=1)
    return vertices, faces[size > 0.0]
