"""Signed distance of rigid probes, with normal and curvature, as Warp functions.

    g(x) = distance to the surface, negative inside;   n = grad g;   C = Hessian of g (curvature of the offset surface)

Sphere, capsule and plane are exact. A cylinder and a box have their edges rounded by `fillet`, so that the normal is
continuous: a press on a mesh cannot resolve a sharper edge anyway.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, ProbeShape, Sphere

SPHERE, CAPSULE, CYLINDER, BOX, PLANE = range(5)
FILLET = 0.02  # of the smallest half-size


def encode(shape: ProbeShape) -> tuple[int, np.ndarray]:
    """A probe as (kind, four numbers) for the kernels; the fourth number is the fillet radius [m]."""
    match shape:
        case Sphere(radius):
            return SPHERE, np.array([radius, 0.0, 0.0, 0.0])
        case Capsule(radius, length):
            return CAPSULE, np.array([radius, 0.5 * length, 0.0, 0.0])
        case Cylinder(radius, height):
            return CYLINDER, np.array([radius, 0.5 * height, 0.0, FILLET * min(radius, 0.5 * height)])
        case Box(size):
            return BOX, np.array([*(0.5 * s for s in size), FILLET * 0.5 * min(size)])
        case Plane():
            return PLANE, np.zeros(4)
    raise AssertionError(shape)


def reach(shape: ProbeShape) -> float:
    """Radius of the smallest ball about the probe's origin that holds it [m]; infinite for a plane."""
    match shape:
        case Sphere(radius):
            return radius
        case Capsule(radius, length):
            return radius + 0.5 * length
        case Cylinder(radius, height):
            return float(np.hypot(radius, 0.5 * height))
        case Box(size):
            return 0.5 * float(np.linalg.norm(size))
        case Plane():
            return float("inf")
    raise AssertionError(shape)


def support(shape: ProbeShape, direction: np.ndarray) -> float:
    """How far the probe reaches from its origin along a unit ``direction`` (3,) of its own frame [m]."""
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


@functools.cache
def functions(real: type, module: str) -> Any:
    """The Warp functions ``gap``, ``normal`` and ``curvature`` of (kind, size, x) for one scalar type, in the caller's ``module``.

    kind and size are those of `encode`; x is in the probe's frame [m]. They give the signed distance [m], its gradient (unit, outward)
    and its Hessian (3, 3) [1/m].
    """
    vec2 = wp.types.vector(length=2, dtype=real)
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    tiny = wp.constant(real(1e-12))

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
    def gap(kind: int, s: vec4, x: vec3):
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
    def normal(kind: int, s: vec4, x: vec3):
        zero = real(0.0)
        one = real(1.0)
        if kind == 4:
            return vec3(zero, zero, one)
        if kind == 3:
            sign = vec3(wp.sign(x[0]), wp.sign(x[1]), wp.sign(x[2]))
            q = vec3(wp.abs(x[0]) - s[0] + s[3], wp.abs(x[1]) - s[1] + s[3], wp.abs(x[2]) - s[2] + s[3])
            out = vec3(wp.max(q[0], zero), wp.max(q[1], zero), wp.max(q[2], zero))
            if wp.length(out) > tiny:
                return wp.cw_mul(sign, unit(out))
            if q[0] >= q[1] and q[0] >= q[2]:
                return vec3(sign[0], zero, zero)
            if q[1] >= q[2]:
                return vec3(zero, sign[1], zero)
            return vec3(zero, zero, sign[2])
        if kind == 2:
            side = vec3(x[0], x[1], zero)
            radial = wp.length(side)
            q0 = radial - s[0] + s[3]
            q1 = wp.abs(x[2]) - s[1] + s[3]
            rim = vec2(wp.max(q0, zero), wp.max(q1, zero))
            a = zero
            b = zero
            if wp.length(rim) > tiny:
                a = rim[0] / wp.length(rim)
                b = rim[1] / wp.length(rim)
            elif q0 >= q1:
                a = one
            else:
                b = one
            across = vec3(one, zero, zero)
            if radial > tiny:
                across = side / radial
            return a * across + vec3(zero, zero, b * wp.sign(x[2]))
        return unit(nearest(kind, s, x))

    @wp.func(module=module)
    def curvature(kind: int, s: vec4, x: vec3):
        # flat parts have none; the fillets' own curvature is left out (it matters on no mesh that we can afford)
        n = normal(kind, s, x)
        eye = mat33(real(1.0), real(0.0), real(0.0), real(0.0), real(1.0), real(0.0), real(0.0), real(0.0), real(1.0))
        if kind == 0:
            return (eye - wp.outer(n, n)) / wp.max(wp.length(x), tiny)
        if kind == 1:
            d = nearest(kind, s, x)
            c = eye - wp.outer(n, n)
            if wp.abs(x[2]) < s[1]:
                c[2, 2] = real(0.0)
            return c / wp.max(wp.length(d), tiny)
        return mat33()

    class Functions:
        pass

    out = Functions()
    out.gap, out.normal, out.curvature = gap, normal, curvature
    return out


def distance(shape: ProbeShape, points: np.ndarray) -> np.ndarray:
    """Signed distance (...,) [m] of ``points`` (..., 3) in the probe's frame, on the host; as the kernels' `gap`."""
    kind, s = encode(shape)
    x = np.asarray(points, float)
    if kind == PLANE:
        return x[..., 2]
    if kind == SPHERE:
        return np.linalg.norm(x, axis=-1) - s[0]
    if kind == CAPSULE:
        axial = x[..., 2] - np.clip(x[..., 2], -s[1], s[1])
        return np.sqrt(x[..., 0] ** 2 + x[..., 1] ** 2 + axial**2) - s[0]
    if kind == CYLINDER:
        q = np.stack([np.hypot(x[..., 0], x[..., 1]) - s[0], np.abs(x[..., 2]) - s[1]], axis=-1) + s[3]
    else:
        q = np.abs(x) - s[:3] + s[3]
    return np.linalg.norm(np.maximum(q, 0.0), axis=-1) + np.minimum(q.max(axis=-1), 0.0) - s[3]
