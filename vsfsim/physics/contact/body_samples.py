"""Points on the surface of a rigid body, edges and corners included, for the check that no body lies inside an
object."""

from __future__ import annotations

import functools

import numpy as np

from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf

_MOST = 20_000  # points of one body
_INNER = 4000  # random points for the inner radius of a mesh
_PROJECTIONS = 3  # steps along the normal onto the rounded surface


@functools.lru_cache(maxsize=64)
def inner_radius(shape: ProbeShape) -> float:
    """Radius [m] of the largest ball inside a body, of a mesh from random points; infinite for a plane."""
    match shape:
        case Sphere(radius) | Capsule(radius, _):
            return radius
        case Cylinder(radius, height):
            return min(radius, 0.5 * height)
        case Box(size):
            return 0.5 * min(size)
        case Plane():
            return float("inf")
    reach = sdf.reach(shape)
    cube = np.random.default_rng(0).uniform(-1.0, 1.0, (_INNER, 3))
    return float(-sdf.distance(shape, reach * np.vstack([np.zeros((1, 3)), cube])).min())


def body_samples(shape: ProbeShape, spacing: float) -> np.ndarray:
    """Points (m, 3) [m] on the surface of a body in its own frame, about ``spacing`` [m] apart.

    A body that is so large that it would have more than 20,000 of them gets a wider spacing. A plane has none: what it
    reaches of an object, it reaches of the object's surface.
    """
    while True:
        points = _points(shape, spacing)
        if len(points) <= _MOST:
            break
        spacing *= 1.1 * np.sqrt(len(points) / _MOST)
    for _ in range(_PROJECTIONS if len(points) else 0):
        gap = sdf.distance(shape, points)
        h = 1e-4 * inner_radius(shape)
        steps = h * np.eye(3)
        slope = np.stack([sdf.distance(shape, points + e) - sdf.distance(shape, points - e) for e in steps], axis=1)
        points = points - gap[:, None] * slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)[:, None]
    return points


def _points(shape: ProbeShape, spacing: float) -> np.ndarray:
    match shape:
        case Sphere(radius):
            return radius * _ball(radius, spacing)
        case Capsule(radius, length):
            ends = radius * _ball(radius, spacing)
            ends[:, 2] += 0.5 * length * np.where(ends[:, 2] < 0.0, -1.0, 1.0)
            return np.vstack([ends, _tube(radius, length, spacing)])
        case Cylinder(radius, height):
            rings = [np.zeros((1, 3)), *(_ring(r, 0.0, spacing) for r in _steps(0.0, radius, spacing)[1:])]
            disc = np.vstack(rings)
            top, bottom = (disc + [0.0, 0.0, z] for z in (0.5 * height, -0.5 * height))
            return np.vstack([top, bottom, _tube(radius, height, spacing)])
        case Box(size):
            axes = [_steps(-0.5 * s, 0.5 * s, spacing) for s in size]
            sides = []
            for k in range(3):
                one, other = (k + 1) % 3, (k + 2) % 3
                grid = np.stack(np.meshgrid(axes[one], axes[other], indexing="ij"), axis=-1).reshape(-1, 2)
                for end in (-0.5 * size[k], 0.5 * size[k]):
                    side = np.empty((len(grid), 3))
                    side[:, one], side[:, other], side[:, k] = grid[:, 0], grid[:, 1], end
                    sides.append(side)
            return np.vstack(sides)
        case MeshFile():
            grid = sdf.grid(shape)
            return _mesh(np.asarray(grid.vertices), np.asarray(grid.faces), spacing)
    return np.zeros((0, 3))


def _steps(low: float, high: float, spacing: float) -> np.ndarray:
    return np.linspace(low, high, max(2, int(np.ceil((high - low) / spacing)) + 1))


def _ball(radius: float, spacing: float) -> np.ndarray:
    """Unit vectors (m, 3): the Fibonacci lattice and the six poles."""
    count = max(60, int(np.ceil(4.0 * np.pi * radius**2 / spacing**2)))
    i = np.arange(count) + 0.5
    z = 1.0 - 2.0 * i / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z**2)
    return np.vstack([np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1), np.eye(3), -np.eye(3)])


def _ring(radius: float, z: float, spacing: float) -> np.ndarray:
    count = max(8, int(np.ceil(2.0 * np.pi * radius / spacing)))
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)


def _tube(radius: float, length: float, spacing: float) -> np.ndarray:
    return np.vstack([_ring(radius, z, spacing) for z in _steps(-0.5 * length, 0.5 * length, spacing)])


def _mesh(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """The corners, and points on a grid over every triangle that is larger than ``spacing``."""
    corner = vertices[faces]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    parts = [vertices]
    for n in np.unique(steps[steps > 1]):
        bary = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        parts.append(np.einsum("sk,fkc->fsc", bary, corner[steps == n]).reshape(-1, 3))
    return np.vstack(parts)
