"""Particles against a sensor surface that deforms: pure sticking (Neural VSF section III-B).

A particle makes contact when a triangle of the surface passes over it from its outer side. It then sticks to that point
of the triangle, which is stored in barycentric coordinates, and moves with it. It detaches and returns to rest when its
spring force points out of the surface. The friction of a rubber bubble is high, so particles do not slide. The position
of the particle is A V, with A made of the barycentric coordinates (III-C), and A^T maps its force to forces on the
vertices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import VsfError

# Number of triangles, nearest by their centres, that are tested for passing over a particle.
_CANDIDATES = 12
# Tolerance of the barycentric coordinates of a crossing, so that rounding lets no particle pass between two triangles
# that share an edge.
_EDGE = 1e-6


@dataclass(frozen=True)
class Displacements:
    """Where a touch moves particles, in CSR form by frame: the result of every motion model, and the input of every
    observation."""

    pointer: np.ndarray
    """Entries of frame t are pointer[t] : pointer[t + 1] (T + 1,) int64."""
    particle: np.ndarray
    """Index of the displaced particle, increasing within a frame (k,) int64."""
    displacement: np.ndarray
    """u = p - p0 of that particle, world (k, 3) float64 [m]."""

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.pointer) - 1

    def frame(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Particles (j,) and displacements (j, 3) [m] of frame ``t``."""
        part = slice(self.pointer[t], self.pointer[t + 1])
        return self.particle[part], self.displacement[part]


@dataclass(frozen=True)
class Contacts(Displacements):
    """Where a touch holds particles."""

    triangle: np.ndarray
    """Triangle that each sticks to (k,) int."""
    weight: np.ndarray
    """Its barycentric coordinates on the triangle (k, 3) [-]."""


def stick(particles: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> Contacts:
    """Move particles with a triangle mesh.

    Args:
        particles: rest positions, world (n, 3) [m]; all are free at frame 0.
        vertices: of the surface, world (T, N, 3) [m]; they move straight between frames.
        triangles: corners, wound outwards (m, 3) int; the surface may be open.

    Raises:
        VsfError: shapes that do not fit, values that are not finite, or corners out of range.
    """
    particles, vertices = np.asarray(particles, np.float64), np.asarray(vertices, np.float64)
    triangles = np.asarray(triangles)
    if (particles.ndim != 2 or particles.shape[1] != 3 or vertices.ndim != 3 or vertices.shape[2] != 3
        or triangles.ndim != 2 or triangles.shape[1] != 3):
        raise VsfError(f"vsf.stick: particles {particles.shape}, vertices {vertices.shape}, triangles "
                       f"{triangles.shape}; give (n, 3), (T, N, 3), (m, 3).")
    if not (np.isfinite(particles).all() and np.isfinite(vertices).all()):
        raise VsfError("vsf.stick: particles and vertices must be finite; leave out frames without a reconstruction of "
                       "the surface.")
    if len(triangles) and not 0 <= triangles.min() <= triangles.max() < vertices.shape[1]:
        raise VsfError(f"vsf.stick: triangles name vertex {triangles.max()}, but the surface has {vertices.shape[1]}.")
    held = np.full(len(particles), -1)
    weight = np.zeros((len(particles), 3))
    near = _within(particles, vertices)
    parts: list[tuple[np.ndarray, ...]] = []
    for t in range(len(vertices)):
        if t:
            free = near[held[near] < 0]
            met, triangle, where = _crossed(particles[free], vertices[t - 1], vertices[t], triangles)
            held[free[met]], weight[free[met]] = triangle, where
        index = near[held[near] >= 0]
        corners = vertices[t][triangles[held[index]]]
        moved = np.einsum("kj,kji->ki", weight[index], corners) - particles[index]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # The spring force is along -u; the particle detaches once that points out of the surface.
        off = np.einsum("ki,ki->k", moved, normal) < 0.0
        held[index[off]] = -1
        index, moved = index[~off], moved[~off]
        parts.append((index, moved, held[index].copy(), weight[index].copy()))
    pointer = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])]).astype(np.int64)
    empty = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros((0, 3)))
    return Contacts(pointer, *(np.concatenate(column) for column in zip(empty, *parts)))


def _within(particles: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Indices of the particles in the bounding box of the surface's path; it reaches no others."""
    if vertices.size == 0:
        return np.zeros(0, np.int64)
    low, high = vertices.min(axis=(0, 1)), vertices.max(axis=(0, 1))
    return np.flatnonzero(np.all((particles >= low) & (particles <= high), axis=1))


def _crossed(points: np.ndarray, before: np.ndarray, after: np.ndarray,
         triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The ``points`` (k, 3) that a triangle passed over between two frames: their indices, the triangles, and the
    barycentric coordinates."""
    none = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    if len(points) == 0 or len(triangles) == 0:
        return none
    middle = 0.5 * (before + after)
    corners = middle[triangles]
    centre = corners.mean(axis=1)
    motion = np.linalg.norm(after - before, axis=1).max()
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max() + 0.5 * motion
    count = min(_CANDIDATES, len(triangles))
    away, candidate = cKDTree(centre).query(points, k=range(1, count + 1), distance_upper_bound=reach)
    point, column = np.nonzero(np.isfinite(away))
    if len(point) == 0:
        return none
    triangle = candidate[point, column]
    p, c0, c1 = points[point], before[triangles[triangle]], after[triangles[triangle]]
    # From in front of the triangle to behind it.
    passed = (_side(p, c0) >= 0.0) & (_side(p, c1) < 0.0)
    point, triangle, p, c0, c1 = point[passed], triangle[passed], p[passed], c0[passed], c1[passed]
    low, high = np.zeros(len(p)), np.ones(len(p))
    for _ in range(40):
        half = 0.5 * (low + high)
        front = _side(p, c0 + half[:, None, None] * (c1 - c0)) >= 0.0
        low, high = np.where(front, half, low), np.where(front, high, half)
    weight = _barycentric(p, c0 + high[:, None, None] * (c1 - c0))
    inside = weight.min(axis=1) >= -_EDGE
    point, triangle, weight, high = point[inside], triangle[inside], weight[inside], high[inside]
    # On a common edge two triangles pass: the earlier one is taken, then the one with the lower index.
    order = np.lexsort((triangle, high, point))
    point, first = np.unique(point[order], return_index=True)
    return point, triangle[order][first], weight[order][first]


def _side(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Six times the signed volume under ``p`` (k, 3) over its triangle (k, 3, 3): positive in front."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.einsum("ki,ki->k", p - corners[:, 0], normal)


def _barycentric(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric coordinates (k, 3) of the foot of ``p`` (k, 3) on its triangle (k, 3, 3)."""
    e1, e2, d = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], p - corners[:, 0]
    a, b, c = (np.einsum("ki,ki->k", x, y) for x, y in ((e1, e1), (e1, e2), (e2, e2)))
    f, g = np.einsum("ki,ki->k", d, e1), np.einsum("ki,ki->k", d, e2)
    determinant = np.maximum(a * c - b * b, 1e-300)
    v, w = (c * f - b * g) / determinant, (a * g - b * f) / determinant
    return np.stack([1.0 - v - w, v, w], axis=1)
