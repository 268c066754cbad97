"""Signed distance of rigid probes, with normal and curvature, as Warp functions.

    g(x) = distance to the surface, negative inside;   n = grad g;   C = Hessian of g (curvature of the offset surface)

Sphere, capsule and plane are exact. A cylinder and a box have edges rounded by a fillet, so that the normal is
continuous: a press on a mesh cannot resolve a sharper edge. A triangle mesh is baked into a grid (`distance_grid`), a
C2 spline whose derivatives are the normal and the curvature. A set of shapes is one struct in the kernels (`bodies`).
The functions for the host are `vsfsim.core.signed_distance`, and here with meshes.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.core import signed_distance
from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere

SPHERE, CAPSULE, CYLINDER, BOX, PLANE, MESH = range(6)
FILLET = 0.02
"""Radius of the fillet, over the smallest half-size [-]."""


def encode(shape: ProbeShape, *, fillet: float = FILLET) -> tuple[int, np.ndarray]:
    """A probe as (kind, four numbers) for the kernels: its half-sizes and the radius of its ``fillet``, which is given
    over the smallest half-size [m]."""
    match shape:
        case Sphere(radius):
            return SPHERE, np.array([radius, 0.0, 0.0, 0.0])
        case Capsule(radius, length):
            return CAPSULE, np.array([radius, 0.5 * length, 0.0, 0.0])
        case Cylinder(radius, height):
            return CYLINDER, np.array([radius, 0.5 * height, 0.0, fillet * min(radius, 0.5 * height)])
        case Box(size):
            return BOX, np.array([*(0.5 * s for s in size), fillet * 0.5 * min(size)])
        case Plane():
            return PLANE, np.zeros(4)
        case MeshFile():
            return MESH, np.zeros(4)
    raise AssertionError(shape)


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
    return signed_distance.distance(shape, points, fillet=float(encode(shape)[1][3]))


def reach(shape: ProbeShape) -> float:
    """Radius of the smallest ball about the probe's origin that holds it [m]; infinite for a plane."""
    if isinstance(shape, MeshFile):
        return float(np.linalg.norm(grid(shape).vertices, axis=1).max())
    return signed_distance.reach(shape)


def support(shape: ProbeShape, direction: np.ndarray) -> float:
    """How far the probe extends from its origin along a unit ``direction`` (3,) of its own frame [m]."""
    if isinstance(shape, MeshFile):
        return float((grid(shape).vertices @ np.asarray(direction, float)).max())
    return signed_distance.support(shape, direction)


@functools.cache
def functions(real: type, module: str) -> Any:
    """The Warp functions of a set of rigid shapes for one scalar type, in the caller's ``module``.

    Returns:
        ``Bodies``: a wp.struct of arrays, filled by `vsfsim.physics.contact.bodies.RigidBodies.upload`.
        ``gap``, ``normal`` and ``curvature`` of (bodies, k, x), x in the frame of body k [m]: the signed distance [m],
        its gradient (3,) [-], outward, and its Hessian (3, 3) [1/m]. The gradient is a unit vector for the analytic
        shapes. For a mesh it is shorter near an edge that the spline rounds, so that a force -k gap normal has a
        potential; friction normalises it.
        ``analytic_gap`` and ``analytic_normal`` of (kind, size, x): the same of one shape as `encode` codes it.
    """
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    tiny = wp.constant(real(1e-12))

    class Bodies:
        kind: wp.array(dtype=wp.int32)  # (K,), as `encode`
        size: wp.array(dtype=vec4)  # (K,), as `encode` [m]
        # of a mesh's grid, see `distance_grid.DistanceGrid`
        start: wp.array(dtype=wp.int32)  # of its coefficients (K,)
        nodes: wp.array(dtype=wp.vec3i)  # (K,)
        origin: wp.array(dtype=vec3)  # node (0, 0, 0) (K,) [m]
        spacing: wp.array(dtype=real)  # (K,) [m]
        lower: wp.array(dtype=vec3)  # corner of the bounding box (K,) [m]
        upper: wp.array(dtype=vec3)  # (K,) [m]
        coefficients: wp.array(dtype=real)  # of all meshes, one after the other [m]

    Bodies = wp.struct(Bodies, module=module)

    @wp.func(module=module)
    def unit(v: vec3):
        # the centre of a sphere has no normal; +z is as good as any and never NaN
        n = wp.length(v)
        if n < tiny:
            return vec3(real(0.0), real(0.0), real(1.0))
        return v / n

    @wp.func(module=module)
    def nearest(kind: int, s: vec4, x: vec3):
        # vector from the probe's skeleton (point, segment, shrunken box) to x, for the rounded shapes
        if kind == 1:
            return vec3(x[0], x[1], x[2] - wp.clamp(x[2], -s[1], s[1]))
        return x

    @wp.func(module=module)
    def rounded(q: vec3, r: real):
        # q: signed excess over the shrunken half-sizes; r: fillet
        zero = real(0.0)
        out = vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
        return wp.length(out) + wp.min(wp.max(q[0], wp.max(q[1], q[2])), zero) - r

    @wp.func(module=module)
    def analytic_gap(kind: int, s: vec4, x: vec3):
        zero = real(0.0)
        if kind == 4:
            return x[2]
        if kind == 3:
            q = vec3(wp.abs(x[0]) - s[0] + s[3], wp.abs(x[1]) - s[1] + s[3], wp.abs(x[2]) - s[2] + s[3])
            return rounded(q, s[3])
        if kind == 2:
            radial = wp.length(vec2(x[0], x[1]))
            p = vec3(radial - s[0] + s[3], wp.abs(x[2]) - s[1] + s[3], real(-1e9))
            rim = vec2(wp.max(p[0], zero), wp.max(p[1], zero))
            return wp.length(rim) + wp.min(wp.max(p[0], p[1]), zero) - s[3]
        return wp.length(nearest(kind, s, x)) - s[0]

    @wp.func(module=module)
    def analytic_normal(kind: int, s: vec4, x: vec3):
        zero = real(0.0)
        one = real(1.0)
        if kind == 4:
            return vec3(zero, zero, one)
        if kind == 3:
            sign = vec3(wp.sign(x[0]), wp.sign(x[1]), wp.sign(x[2]))
            q = vec3(wp.abs(x[0]) - s[0] + s[3], wp.abs(x[1]) - s[1] + s[3], wp.abs(x[2]) - s[2] + s[3])
            out = vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
            far = wp.length(out)
            if far > zero:
                return wp.cw_mul(sign, out / far)
            if q[2] >= q[0] and q[2] >= q[1]:
                return vec3(zero, zero, sign[2])
            if q[0] >= q[1]:
                return vec3(sign[0], zero, zero)
            return vec3(zero, sign[1], zero)
        if kind == 2:
            side = vec3(x[0], x[1], zero)
            radial = wp.length(side)
            q0 = radial - s[0] + s[3]
            q1 = wp.abs(x[2]) - s[1] + s[3]
            rim = vec2(wp.max(q0, zero), wp.max(q1, zero))
            a = zero
            b = zero
            if wp.length(rim) > zero:
                a = rim[0] / wp.length(rim)
                b = rim[1] / wp.length(rim)
            elif q0 > q1:
                a = one
            else:
                b = one
            across = vec3(one, zero, zero)
            if radial > zero:
                across = side / radial
            return a * across + vec3(zero, zero, b * wp.sign(x[2]))
        d = nearest(kind, s, x)
        if kind == 1 and wp.length(d) == zero:
            return vec3(one, zero, zero)  # on the axis any direction across it is as good
        return unit(d)

    @wp.func(module=module)
    def analytic_curvature(kind: int, s: vec4, x: vec3):
        zero = real(0.0)
        one = real(1.0)
        n = analytic_normal(kind, s, x)
        eye = mat33(real(1.0), real(0.0), real(0.0), real(0.0), real(1.0), real(0.0), real(0.0), real(0.0), real(1.0))
        if kind == 0:
            return (eye - wp.outer(n, n)) / wp.max(wp.length(x), tiny)
        if kind == 1:
            d = nearest(kind, s, x)
            c = eye - wp.outer(n, n)
            if wp.abs(x[2]) < s[1]:
                c[2, 2] = real(0.0)
            return c / wp.max(wp.length(d), tiny)
        if kind == 3:
            # on a fillet, across the normal: of the directions that it rounds; bounded far inside, near its middle
            q = vec3(wp.abs(x[0]) - s[0] + s[3], wp.abs(x[1]) - s[1] + s[3], wp.abs(x[2]) - s[2] + s[3])
            out = vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
            c = wp.diag(vec3(wp.step(-q[0]), wp.step(-q[1]), wp.step(-q[2]))) - wp.outer(n, n)
            far = wp.length(out)
            if far > zero:
                return c / wp.max(far, real(0.5) * s[3])
            return mat33()
        if kind == 2:
            c = mat33()
            radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
            q0 = radial - s[0] + s[3]
            q1 = wp.abs(x[2]) - s[1] + s[3]
            side = vec3(one, zero, zero)
            if radial > zero:
                side = vec3(x[0] / radial, x[1] / radial, zero)
            around = vec3(-side[1], side[0], zero)
            out_of = wp.dot(n, side)
            c = out_of / wp.max(radial, tiny) * wp.outer(around, around)
            if q0 > zero and q1 > zero:
                along = wp.cross(around, n)
                c = c + wp.outer(along, along) / wp.max(wp.sqrt(q0 * q0 + q1 * q1), real(0.5) * s[3])
            return c
        return mat33()

    @wp.func(module=module)
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

    @wp.func(module=module)
    def cell_of(bodies: Bodies, k: int, x: vec3):
        # the four nodes along each axis begin one before the cell; the last full cell serves the rim of the domain
        c = (x - bodies.origin[k]) / bodies.spacing[k]
        n = bodies.nodes[k]
        return wp.vec3i(wp.clamp(int(wp.floor(c[0])), 1, n[0] - 3), wp.clamp(int(wp.floor(c[1])), 1, n[1] - 3),
                        wp.clamp(int(wp.floor(c[2])), 1, n[2] - 3))

    @wp.func(module=module)
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

    @wp.func(module=module)
    def within(bodies: Bodies, k: int, x: vec3):
        # the nearest point of the box in which the spline holds
        h = bodies.spacing[k]
        o = bodies.origin[k]
        n = bodies.nodes[k]
        return vec3(wp.clamp(x[0], o[0] + h, o[0] + h * real(n[0] - 2)),
                    wp.clamp(x[1], o[1] + h, o[1] + h * real(n[1] - 2)),
                    wp.clamp(x[2], o[2] + h, o[2] + h * real(n[2] - 2)))

    @wp.func(module=module)
    def from_box(bodies: Bodies, k: int, x: vec3):
        # vector from the bounding box to a point outside it
        low = bodies.lower[k]
        high = bodies.upper[k]
        return x - vec3(wp.clamp(x[0], low[0], high[0]), wp.clamp(x[1], low[1], high[1]),
                        wp.clamp(x[2], low[2], high[2]))

    @wp.func(module=module)
    def gap(bodies: Bodies, k: int, x: vec3):
        if bodies.kind[k] < 5:
            return analytic_gap(bodies.kind[k], bodies.size[k], x)
        inside = within(bodies, k, x)
        phi = derivative(bodies, k, inside, 0, 0, 0)
        away = wp.length(x - inside)
        if away > real(0.0):
            return wp.max(phi - away, wp.length(from_box(bodies, k, x)))
        return phi

    @wp.func(module=module)
    def normal(bodies: Bodies, k: int, x: vec3):
        if bodies.kind[k] < 5:
            return analytic_normal(bodies.kind[k], bodies.size[k], x)
        if wp.length(x - within(bodies, k, x)) > real(0.0):
            return unit(from_box(bodies, k, x))
        return vec3(derivative(bodies, k, x, 1, 0, 0), derivative(bodies, k, x, 0, 1, 0),
                    derivative(bodies, k, x, 0, 0, 1))

    @wp.func(module=module)
    def curvature(bodies: Bodies, k: int, x: vec3):
        if bodies.kind[k] < 5:
            return analytic_curvature(bodies.kind[k], bodies.size[k], x)
        c = mat33()
        if wp.length(x - within(bodies, k, x)) > real(0.0):
            return c
        c[0, 0] = derivative(bodies, k, x, 2, 0, 0)
        c[1, 1] = derivative(bodies, k, x, 0, 2, 0)
        c[2, 2] = derivative(bodies, k, x, 0, 0, 2)
        c[0, 1] = derivative(bodies, k, x, 1, 1, 0)
        c[1, 2] = derivative(bodies, k, x, 0, 1, 1)
        c[0, 2] = derivative(bodies, k, x, 1, 0, 1)
        c[1, 0] = c[0, 1]
        c[2, 1] = c[1, 2]
        c[2, 0] = c[0, 2]
        return c

    return SimpleNamespace(Bodies=Bodies, gap=gap, normal=normal, curvature=curvature, analytic_gap=analytic_gap,
                           analytic_normal=analytic_normal, vec3=vec3, vec4=vec4, real=real)
