"""Points on the surface of a rigid body, edges and corners included, for the check that no body lies inside an
object, and those of its edges, corners and rims, which are contact points."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.patch import face_grid

T = TypeVar("T")
_MOST_POINTS = 20_000  # points of one body
_INNER = 4000  # random points for the inner radius of a mesh
_MOST_SHARP = 2000  # points of its edges, corners and rims
_CREASE = np.radians(30.0)  # turn of the outward side at an edge of a mesh
_CUBE = 0.8  # edge of the cubes that hold one point each, over the spacing
_APART = 1.6  # spacing over the root of the surface that one of those points stands for
_ROUND, _SIDES = 3, 48  # subdivisions of an icosahedron that is a ball; sides of a polygon that is a circle


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
    vertices, faces = surface(shape)
    corner = vertices[faces]
    side = corner - np.roll(corner, 1, axis=1)
    area = 0.5 * float(np.linalg.norm(np.cross(side[:, 0], side[:, 1]), axis=1).sum())
    spacing = max(spacing, _APART * np.sqrt(area / _MOST_POINTS))
    # the corners, and points on a grid over every triangle that is larger, one in a cube
    steps = np.maximum(1, np.ceil(np.linalg.norm(side, axis=2).max(axis=1, initial=0.0) / spacing)).astype(int)
    points = np.vstack([vertices, *(np.einsum("sk,fkc->fsc", face_grid(n, 3), corner[steps == n]).reshape(-1, 3)
                                    for n in np.unique(steps[steps > 1]))])
    points = points[np.unique(np.round(points / (_CUBE * spacing)), axis=0, return_index=True)[1]]
    # onto the rounded surface: one step, for the distance is exact
    step = 1e-4 * min(inner_radius(shape), 1.0) * np.eye(3)
    slope = np.stack([sdf.distance(shape, points + e) - sdf.distance(shape, points - e) for e in step], axis=1)
    slope /= np.maximum(np.linalg.norm(slope, axis=1), 1e-12)[:, None]
    return points - sdf.distance(shape, points)[:, None] * slope


@_kept
def has_edges(shape: ProbeShape) -> bool:
    """Whether a body has edges, corners or rims; the mesh of a smooth body has none."""
    return len(sharp_samples(shape, float("inf"))[0]) > 0


def sharp_samples(shape: ProbeShape, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on the edges, corners and rims of a body in its own frame, at most ``spacing`` [m] apart, wider where a
    body would have more than 2,000 of them.

    Returns:
        The points (m, 3) [m] of the body without its fillet, the mean outward directions of the sides that meet there
        (m, 3) [-], and the length of edge that each stands for (m,) [m], 0 at a corner.
    """
    match shape:
        case Cylinder(radius, height):
            # between two points of a rim it bulges by less than a hundredth of their distance
            ring = _ring(radius, 0.5 * height, min(spacing, np.sqrt(0.03 * radius * spacing)))
            points = np.vstack([ring, ring * [1.0, 1.0, -1.0]])
            outward = points / np.array([radius, radius, 0.5 * height])
            found = points, outward / np.sqrt(2.0), np.full(len(points), np.pi * radius / (len(ring) / 2.0))
        case Box() | MeshFile():
            found = _creases(*surface(shape), spacing)
        case _:
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    many = len(found[0]) / _MOST_SHARP
    return sharp_samples(shape, 1.1 * spacing * many) if many > 1.0 else found


def _creases(vertices: np.ndarray, faces: np.ndarray,
             spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a closed triangle mesh: edges where its outward side turns by more than `_CREASE`, convex ones, since
    a concave one meets nothing, and the corners where more than two of them meet or their line bends."""
    import trimesh  # a sphere does not need it

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    sharp = (mesh.face_adjacency_angles > _CREASE) & mesh.face_adjacency_convex
    ends, outward = mesh.face_adjacency_edges[sharp], mesh.face_normals[mesh.face_adjacency[sharp]].sum(axis=1)
    way = vertices[ends[:, 1]] - vertices[ends[:, 0]]
    length = np.linalg.norm(way, axis=1)
    count = np.maximum(1, np.ceil(length / spacing).astype(int) - 1)  # points of each edge, its ends not included
    edge = np.repeat(np.arange(len(ends)), count)
    part = (np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count) + 1.0) / (count + 1.0)[edge]
    corner, at = np.unique(ends, return_inverse=True)
    at, leave, mean = at.reshape(-1, 2), np.zeros((len(corner), 3)), np.zeros((len(corner), 3))
    along = way / np.maximum(length, 1e-300)[:, None]
    for k, sign in ((0, 1.0), (1, -1.0)):
        np.add.at(leave, at[:, k], sign * along)
        np.add.at(mean, at[:, k], outward)
    stands = (length / (count + 1.0))[edge]
    # a corner on a line that goes on straight stands for half of each edge beside it
    straight = (np.bincount(at.ravel(), minlength=len(corner)) == 2) & (
        (leave**2).sum(axis=1) < 2.0 - 2.0 * np.cos(_CREASE))
    half = min(spacing, float(np.median(stands))) if len(stands) else 0.0
    out = np.vstack([outward[edge], mean])
    return (np.vstack([vertices[ends[edge, 0]] + part[:, None] * way[edge], vertices[corner]]),
            out / np.maximum(np.linalg.norm(out, axis=1), 1e-12)[:, None],
            np.concatenate([stands, np.where(straight, half, 0.0)]))


def surface(shape: ProbeShape) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3) [m] and triangles (f, 3), wound outwards, of a mesh, or of a polyhedron that is like the shape, in
    the body's frame; none of a plane."""
    from trimesh import creation  # imports much

    match shape:
        case MeshFile():
            made = sdf.grid(shape)
        case Sphere(radius):
            made = creation.icosphere(_ROUND, radius)
        case Capsule(radius, length):
            made = creation.capsule(length, radius, count=[_SIDES // 2, _SIDES])
        case Cylinder(radius, height):
            made = creation.cylinder(radius, height, sections=_SIDES)
        case Box(size):
            made = creation.box(size)
        case _:
            return np.zeros((0, 3)), np.zeros((0, 3), int)
    return np.asarray(made.vertices), np.asarray(made.faces)


def _ring(radius: float, z: float, spacing: float) -> np.ndarray:
    count = max(8, int(np.ceil(2.0 * np.pi * radius / spacing)))
    angle = 2.0 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=1)
