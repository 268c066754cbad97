"""Points on the surface of a rigid body, edges and corners included, for the check that no body lies inside an
object, and those of its edges, corners and rims, which are contact points."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from scipy.spatial import ConvexHull

from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf

T = TypeVar("T")
_MOST_POINTS = 20_000  # points of one body
_INNER = 4000  # random points for the inner radius of a mesh
_MOST_SHARP = 2000  # points of its edges, corners and rims
_CREASE = np.radians(30.0)  # turn of the outward side at an edge of a mesh
_CUBE = 0.8  # edge of the cubes that hold one point each, over the spacing
_PROJECTIONS = 3  # steps along the normal onto the rounded surface


def _kept(of_shape: Callable[[ProbeShape], T]) -> Callable[[ProbeShape], T]:
    """``of_shape``, remembered: of a mesh as long as its file has the same content, whose grid is then the same."""
    kept = functools.lru_cache(maxsize=64)(lambda shape, grid: of_shape(shape))
    return lambda shape: kept(shape, sdf.grid(shape) if isinstance(shape, MeshFile) else None)


@_kept
def inner_radius(shape: ProbeShape) -> float:
    """Radius [m] of the largest ball inside a body, of a mesh from random points; infinite for a plane."""
    if isinstance(shape, Plane):
        return float("inf")
    points = np.zeros((1, 3))  # of a solid of ours the middle is deepest
    if isinstance(shape, MeshFile):
        points = np.vstack([points, sdf.reach(shape) * np.random.default_rng(0).uniform(-1.0, 1.0, (_INNER, 3))])
    return float(-sdf.distance(shape, points).min())


def body_samples(shape: ProbeShape, spacing: float) -> np.ndarray:
    """Points (m, 3) [m] on the surface of a body in its own frame, about ``spacing`` [m] apart.

    A body that is so large that it would have more than 20,000 of them gets a wider spacing. A plane has none: what it
    reaches of an object, it reaches of the object's surface.
    """
    while True:
        points = _mesh(*_surface(shape, spacing), spacing)
        if len(points) <= _MOST_POINTS:
            break
        spacing *= 1.1 * np.sqrt(len(points) / _MOST_POINTS)
    for _ in range(_PROJECTIONS if len(points) else 0):
        gap = sdf.distance(shape, points)
        h = 1e-4 * inner_radius(shape)
        steps = h * np.eye(3)
        slope = np.stack([sdf.distance(shape, points + e) - sdf.distance(shape, points - e) for e in steps], axis=1)
        points = points - gap[:, None] * slope / np.maximum(np.linalg.norm(slope, axis=1), 1e-12)[:, None]
    return points


@_kept
def has_edges(shape: ProbeShape) -> bool:
    """Whether a body has edges, corners or rims; the mesh of a smooth body has none."""
    return len(_sharp(shape, float("inf"))[0]) > 0


def sharp_samples(shape: ProbeShape, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the edges, corners and rims of a body in its own frame, at most ``spacing`` [m] apart, wider where a
    body would have more than 2,000 of them.

    Returns:
        The points (m, 3) [m] of the body without its fillet, the mean outward directions of the sides that meet there
        (m, 3) [-], and the length of edge that each stands for (m,) [m], 0 at a corner.
    """
    while True:
        points, outward, length = _sharp(shape, spacing)
        if len(points) <= _MOST_SHARP:
            break
        spacing *= 1.1 * len(points) / _MOST_SHARP
    return points, outward, length


def _sharp(shape: ProbeShape, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    match shape:
        case Cylinder(radius, height):
            # between two points of a rim it bulges by less than a hundredth of their distance
            ring = _ring(radius, 0.5 * height, min(spacing, np.sqrt(0.03 * radius * spacing)))
            points = np.vstack([ring, ring * [1.0, 1.0, -1.0]])
            outward = points / np.array([radius, radius, 0.5 * height])
            return points, outward / np.sqrt(2.0), np.full(len(points), np.pi * radius / (len(ring) / 2.0))
        case Box() | MeshFile():
            return _creases(*_surface(shape, spacing), spacing)
    return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)


def _edges(edges: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
           corners: Sequence[tuple[np.ndarray, np.ndarray]],
           spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of straight ``edges`` (two ends, outward), ends not included, and of ``corners`` (place, outward)."""
    points, outward, length = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for a, b, out in edges:
        way = float(np.linalg.norm(b - a))
        count = max(1, int(np.ceil(way / spacing)) - 1)
        points.append(a + (np.arange(1, count + 1) / (count + 1))[:, None] * (b - a))
        outward.append(np.repeat(out[None], count, axis=0))
        length.append(np.full(count, way / (count + 1)))
    for place, out in corners:
        points.append(place[None])
        outward.append(out[None])
        length.append(np.zeros(1))
    out = np.vstack(outward)
    return np.vstack(points), out / np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None], np.concatenate(length)


def _creases(vertices: np.ndarray, faces: np.ndarray,
             spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a closed triangle mesh: edges where its outward side turns by more than `_CREASE`, convex ones, and
    the corners where more than two of them meet or their line bends."""
    across = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    normal = across / np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
    sides: dict[tuple[int, int], list[int]] = {}
    for f, face in enumerate(faces.tolist()):
        for i in range(3):
            a, b = face[i], face[(i + 1) % 3]
            sides.setdefault((min(a, b), max(a, b)), []).append(f)
    edges, at = [], {}
    for (a, b), both in sides.items():
        if len(both) != 2 or normal[both[0]] @ normal[both[1]] > np.cos(_CREASE):
            continue
        far = next(v for v in faces[both[1]] if v not in (a, b))
        if normal[both[0]] @ (vertices[far] - vertices[a]) > 0.0:
            continue  # a concave crease meets nothing
        out = normal[both[0]] + normal[both[1]]
        edges.append((vertices[a], vertices[b], out))
        way = (vertices[b] - vertices[a]) / max(float(np.linalg.norm(vertices[b] - vertices[a])), 1e-300)
        at.setdefault(a, []).append((way, out))
        at.setdefault(b, []).append((-way, out))
    corners = [(vertices[v], np.sum([out for _, out in ways], axis=0)) for v, ways in at.items()]
    points, outward, length = _edges(edges, corners, spacing)
    # a corner on a line that goes on straight stands for half of each edge beside it
    straight = [len(ways) == 2 and ways[0][0] @ ways[1][0] < -np.cos(_CREASE) for ways in at.values()]
    if any(straight):
        length[len(points) - len(corners):][straight] = min(spacing, float(np.median(length[length > 0.0])))
    return points, outward, length


def _surface(shape: ProbeShape, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3) [m] and triangles (f, 3), wound outwards, of a mesh, or of a polyhedron that is like the shape and
    whose points the steps onto its surface bring there; none of a plane."""
    match shape:
        case MeshFile():
            grid = sdf.grid(shape)
            return np.asarray(grid.vertices), np.asarray(grid.faces)
        case Sphere() | Capsule():
            golden = 0.5 * (1.0 + np.sqrt(5.0))
            quarter = np.array([[0.0, one, other * golden] for one in (-1.0, 1.0) for other in (-1.0, 1.0)])
            corners = np.vstack([np.roll(quarter, k, axis=1) for k in range(3)])  # of an icosahedron
            corners *= shape.radius / np.hypot(1.0, golden)
            corners[:, 2] += 0.5 * getattr(shape, "length", 0.0) * np.where(corners[:, 2] < 0.0, -1.0, 1.0)
        case Cylinder(radius, height):
            corners = np.vstack([_ring(radius, z, spacing) for z in (-0.5 * height, 0.5 * height)])
        case Box(size):
            corners = np.array(list(np.ndindex(2, 2, 2))) * np.array(size) - 0.5 * np.array(size)
        case _:
            return np.zeros((0, 3)), np.zeros((0, 3), int)
    hull = ConvexHull(corners)
    a, b, c = (corners[hull.simplices[:, k]] for k in range(3))
    inward = np.einsum("fc,fc->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    return corners, np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)


def _ring(radius: float, z: float, spacing: float) -> np.ndarray:
    count = max(8, int(np.ceil(2.0 * np.pi * radius / spacing)))
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)


def _mesh(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """The corners, and points on a grid over every triangle that is larger than ``spacing``, one in a cube of it."""
    corner = vertices[faces]
    longest = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1, initial=0.0)
    steps = np.maximum(1, np.ceil(longest / spacing)).astype(int)
    parts = [vertices]
    for n in np.unique(steps[steps > 1]):
        bary = np.array([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
        parts.append(np.einsum("sk,fkc->fsc", bary, corner[steps == n]).reshape(-1, 3))
    points = np.vstack(parts)
    return points[np.unique(np.round(points / (_CUBE * spacing)), axis=0, return_index=True)[1]]
