"""Signed distance of rigid probes, with normal and curvature, as Warp functions.

    g(x) = distance to the surface, negative inside;   n = grad g;   C = Hessian of g (curvature of the offset surface)

Sphere, capsule and plane are exact. A cylinder and a box have edges rounded by a fillet, so that the normal is
continuous: a press on a mesh cannot resolve a sharper edge. All but the plane are what is nearer than a radius to a
box, the skeleton: of a sphere a point, of a capsule a segment. A triangle mesh is baked into a grid
(`distance_grid`), a C2 spline whose derivatives are the normal and the curvature. A set of shapes is one struct,
`Bodies`. In ``gap``, ``normal`` and ``curvature`` of (bodies, k, x) x is in the frame of body k [m]. The normal is a
unit vector for the analytic shapes. For a mesh it is shorter near an edge that the spline rounds, so that a force
-k gap normal has a potential; friction normalises it.
The functions for the host are `vsfsim.core.shape`, and here with meshes.
"""

from typing import Any

import numpy as np
import warp as wp

from vsfsim.core import shape as shapes
from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.physics.runtime import mat33, real, vec3

vec2, vec4 = wp.vec2d, wp.vec4d
ROUNDED, CYLINDER, PLANE, MESH = range(4)
FILLET = 0.02
"""Radius of the fillet, over the smallest half-size [-]."""


def encode(shape: ProbeShape, *, fillet: float = FILLET) -> tuple[int, np.ndarray]:
    """A probe as (kind, four numbers) for the kernels: the half-sizes of its skeleton and the radius around that [m]. A
    sphere is a rounded point, a capsule a rounded line, and a box or a cylinder has a ``fillet``, which is given over
    the smallest half-size."""
    match shape:
        case Sphere(radius):
            return ROUNDED, np.array([0.0, 0.0, 0.0, radius])
        case Capsule(radius, length):
            return ROUNDED, np.array([0.0, 0.0, 0.5 * length, radius])
        case Box(size):
            half, kind = 0.5 * np.array(size), ROUNDED
        case Cylinder(radius, height):
            half, kind = np.array([radius, np.inf, 0.5 * height]), CYLINDER
        case Plane():
            return PLANE, np.zeros(4)
        case MeshFile():
            return MESH, np.zeros(4)
    rounding = fillet * half.min()
    return kind, np.array([*(half - rounding), rounding])


def grid(shape: MeshFile) -> Any:
    """The baked `DistanceGrid` of a mesh probe."""
    # the grid pulls in scipy.ndimage and trimesh; a sphere does not need them
    from vsfsim.physics.contact.distance_grid import baked

    return baked(shape)


def distance(shape: ProbeShape, points: np.ndarray) -> np.ndarray:
    """Signed distance (...,) [m] of ``points`` (..., 3) [m] in the probe's frame, on the host; as the kernels'
    ``gap``."""
    if isinstance(shape, MeshFile):
        return grid(shape).distance(points)
    return shapes.distance(shape, points, fillet=float(encode(shape)[1][3]))


def reach(shape: ProbeShape) -> float:
    """Radius of the smallest ball about the probe's origin that holds it [m]; infinite for a plane."""
    if isinstance(shape, MeshFile):
        return float(np.linalg.norm(grid(shape).vertices, axis=1).max())
    return shapes.reach(shape)


def support(shape: ProbeShape, direction: np.ndarray) -> float:
    """How far the probe extends from its origin along a unit ``direction`` (3,) of its own frame [m]."""
    if isinstance(shape, MeshFile):
        return float((grid(shape).vertices @ np.asarray(direction, float)).max())
    return shapes.support(shape, direction)


@wp.struct
class Bodies:
    """A set of rigid shapes, filled by `bodies.RigidBodies.upload`."""

    kind: wp.array(dtype=wp.int32)  # (K,), as `encode`
    size: wp.array(dtype=vec4)  # (K,), as `encode` [m]
    # of a mesh's grid, see `distance_grid.DistanceGrid`
    start: wp.array(dtype=wp.int32)  # of its coefficients (K,)
    nodes: wp.array(dtype=wp.vec3i)  # (K,)
    origin: wp.array(dtype=vec3)  # node (0, 0, 0) (K,) [m]
    spacing: wp.array(dtype=real)  # (K,) [m]
    coefficients: wp.array(dtype=real)  # of all meshes, one after the other [m]


@wp.func
def axes(kind: int, x: vec3):
    # columns: the axes of a box; of a cylinder, which is a box in every plane through its axis, those of the plane
    # through x, along the radius, around and along its axis
    c = real(1.0)
    s = real(0.0)
    radial = wp.length(vec2(x[0], x[1]))
    if kind == 1 and radial > real(0.0):
        c = x[0] / radial
        s = x[1] / radial
    return mat33(c, -s, real(0.0), s, c, real(0.0), real(0.0), real(0.0), real(1.0))


@wp.func
def excess(kind: int, s: vec4, x: vec3):
    # how far a point is beyond the half-sizes of the skeleton, along its axes
    y = wp.transpose(axes(kind, x)) * x
    return vec3(wp.abs(y[0]) - s[0], wp.abs(y[1]) - s[1], wp.abs(y[2]) - s[2])


@wp.func
def outside(q: vec3):
    zero = real(0.0)
    return vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))


@wp.func
def analytic_gap(kind: int, s: vec4, x: vec3):
    if kind == 2:
        return x[2]
    q = excess(kind, s, x)
    return wp.length(outside(q)) + wp.min(wp.max(q[0], wp.max(q[1], q[2])), real(0.0)) - s[3]


@wp.func
def along_axes(kind: int, s: vec4, x: vec3):
    # the normal along `axes`; where the skeleton has none, as in the centre of a sphere, any is as good
    q = excess(kind, s, x)
    out = outside(q)
    y = wp.transpose(axes(kind, x)) * x
    far = wp.length(out)
    if far > real(0.0):
        return wp.cw_mul(vec3(wp.sign(y[0]), wp.sign(y[1]), wp.sign(y[2])), out / far)
    n = vec3()
    if q[2] >= q[0] and q[2] >= q[1]:
        n[2] = wp.sign(y[2])
    elif q[0] >= q[1]:
        n[0] = wp.sign(y[0])
    else:
        n[1] = wp.sign(y[1])
    return n


@wp.func
def analytic_normal(kind: int, s: vec4, x: vec3):
    if kind == 2:
        return vec3(real(0.0), real(0.0), real(1.0))
    return axes(kind, x) * along_axes(kind, s, x)


@wp.func
def analytic_curvature(kind: int, s: vec4, x: vec3):
    # where the surface is round, across the normal, of the directions that it rounds; bounded far inside
    c = mat33()
    if kind == 2:
        return c
    q = excess(kind, s, x)
    n = along_axes(kind, s, x)
    far = wp.length(outside(q))
    if far > real(0.0):
        c = wp.diag(vec3(wp.step(-q[0]), wp.step(-q[1]), wp.step(-q[2]))) - wp.outer(n, n)
        c = c / wp.max(far, real(0.5) * s[3])
    if kind == 1:
        c[1, 1] = n[0] / wp.max(wp.length(vec2(x[0], x[1])), real(1e-12))
    turn = axes(kind, x)
    return turn * c * wp.transpose(turn)


@wp.func
def weights(t: real, order: int):
    # cubic B-spline of the four nodes around a point at t (0..1) between the middle two, or its derivatives by t
    one = real(1.0)
    half = real(0.5)
    r = one - t
    if order == 0:
        return vec4(r * r * r, real(4.0) - real(3.0) * t * t * (one + r), real(4.0) - real(3.0) * r * r * (one + t),
                    t * t * t) / real(6.0)
    if order == 1:
        return vec4(-half * r * r, half * t * (real(3.0) * t - real(4.0)),
                    half * (one + real(2.0) * t - real(3.0) * t * t), half * t * t)
    return vec4(r, real(3.0) * t - real(2.0), one - real(3.0) * t, t)


@wp.func
def cell_of(bodies: Bodies, k: int, x: vec3):
    # the four nodes along each axis begin one before the cell; the last full cell serves the rim of the domain
    c = (x - bodies.origin[k]) / bodies.spacing[k]
    n = bodies.nodes[k]
    return wp.vec3i(wp.clamp(int(wp.floor(c[0])), 1, n[0] - 3), wp.clamp(int(wp.floor(c[1])), 1, n[1] - 3),
                    wp.clamp(int(wp.floor(c[2])), 1, n[2] - 3))


@wp.func
def derivative(bodies: Bodies, k: int, x: vec3, a: int, b: int, c: int):
    # d^(a+b+c) phi / dx^a dy^b dz^c at a point of the grid's domain
    h = bodies.spacing[k]
    cell = cell_of(bodies, k, x)
    n = bodies.nodes[k]
    t = (x - bodies.origin[k]) / h
    wx = weights(t[0] - real(cell[0]), a)
    wy = weights(t[1] - real(cell[1]), b)
    wz = weights(t[2] - real(cell[2]), c)
    four = int(4)  # noqa: RUF046, UP018  a variable in Warp, so that the loops are not unrolled into 64 copies
    total = real(0.0)
    for i in range(four):
        for j in range(four):
            row = bodies.start[k] + ((cell[0] - 1 + i) * n[1] + cell[1] - 1 + j) * n[2] + cell[2] - 1
            along = real(0.0)
            for m in range(four):
                along += wz[m] * bodies.coefficients[row + m]
            total += wx[i] * wy[j] * along
    for _i in range(a + b + c):
        total = total / h
    return total


@wp.func
def within(bodies: Bodies, k: int, x: vec3):
    # the nearest point of the box in which the spline holds
    h = bodies.spacing[k]
    o = bodies.origin[k]
    n = bodies.nodes[k]
    return vec3(wp.clamp(x[0], o[0] + h, o[0] + h * real(n[0] - 2)),
                wp.clamp(x[1], o[1] + h, o[1] + h * real(n[1] - 2)),
                wp.clamp(x[2], o[2] + h, o[2] + h * real(n[2] - 2)))


@wp.func
def gap(bodies: Bodies, k: int, x: vec3):
    if bodies.kind[k] < 3:
        return analytic_gap(bodies.kind[k], bodies.size[k], x)
    inside = within(bodies, k, x)
    phi = derivative(bodies, k, inside, 0, 0, 0)
    away = wp.length(x - inside)
    return wp.where(away > real(0.0), wp.max(phi - away, away), phi)


@wp.func
def normal(bodies: Bodies, k: int, x: vec3):
    if bodies.kind[k] < 3:
        return analytic_normal(bodies.kind[k], bodies.size[k], x)
    away = x - within(bodies, k, x)
    if wp.length(away) > real(0.0):
        return wp.normalize(away)
    return vec3(derivative(bodies, k, x, 1, 0, 0), derivative(bodies, k, x, 0, 1, 0),
                derivative(bodies, k, x, 0, 0, 1))


@wp.func
def curvature(bodies: Bodies, k: int, x: vec3):
    if bodies.kind[k] < 3:
        return analytic_curvature(bodies.kind[k], bodies.size[k], x)
    if wp.length(x - within(bodies, k, x)) > real(0.0):
        return mat33()
    xy = derivative(bodies, k, x, 1, 1, 0)
    yz = derivative(bodies, k, x, 0, 1, 1)
    zx = derivative(bodies, k, x, 1, 0, 1)
    return mat33(derivative(bodies, k, x, 2, 0, 0), xy, zx, xy, derivative(bodies, k, x, 0, 2, 0), yz,
                 zx, yz, derivative(bodies, k, x, 0, 0, 2))
