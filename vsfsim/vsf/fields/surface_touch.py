"""Touches of a sensor with a surface: the force on each of its vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class DenseTouch:
    """One touch of a sensor with a surface."""

    vertices: np.ndarray
    """World positions of the surface's vertices (T, N, 3) [m]."""
    triangles: np.ndarray
    """Corners, wound outwards (m, 3)."""
    force: np.ndarray
    """Force of the object on each vertex, world (T, N, 3) [N]."""


def dome(*, radius: float = 0.03, height: float = 0.015, rings: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A cap of a ball, apex down at the origin: vertices (N, 3) [m] and triangles (m, 3) wound outwards (down).

    Args:
        radius: of its rim [m].
        height: of the rim over the apex [m].
        rings: of vertices; N = 1 + 3 rings (rings + 1).
    """
    ball = (radius**2 + height**2) / (2.0 * height)
    points, start = [np.zeros((1, 3))], [0]
    for ring in range(1, rings + 1):
        r = radius * ring / rings
        angle = 2.0 * np.pi * np.arange(6 * ring) / (6 * ring)
        start.append(start[-1] + (6 * (ring - 1) if ring > 1 else 1))
        points.append(np.stack([r * np.cos(angle), r * np.sin(angle),
                                np.full(6 * ring, ball - np.sqrt(ball**2 - r**2))], axis=1))
    triangles = []
    for ring in range(1, rings + 1):
        for side in range(6):
            for step in range(ring):
                outer = start[ring] + (side * ring + step) % (6 * ring)
                after = start[ring] + (side * ring + step + 1) % (6 * ring)
                inner = start[ring - 1] + (side * (ring - 1) + step) % max(6 * (ring - 1), 1)
                triangles.append((inner, after, outer))
                if step < ring - 1:
                    triangles.append((inner, start[ring - 1] + (side * (ring - 1) + step + 1) % (6 * (ring - 1)),
                                      after))
    return np.concatenate(points), np.array(triangles)


def oriented_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area vectors of the triangles around each vertex (..., N, 3) [m^2] (Neural VSF section III-D)."""
    a, b, c = (vertices[..., triangles[:, k], :] for k in range(3))
    area = np.cross(b - a, c - a) / 6.0
    out = np.zeros_like(vertices)
    flat, given = out.reshape(-1, *vertices.shape[-2:]), area.reshape(-1, *area.shape[-2:])
    for frame, part in zip(flat, given):
        for k in range(3):
            np.add.at(frame, triangles[:, k], part)
    return out
