"""Triangle: a membrane in plane stress with three nodes, at any stretch, flat and stress-free in a rest shape of its
own.

    E(x) = A W(l1, l2),   F = [x1 - x0, x2 - x0] R^-1  (3 x 2),   l1 >= l2 its singular values,
    W = mu h/2 (l1^2 + l2^2 + 1/(l1 l2)^2 - 3),   mu h = M/3,

with A and R (2 x 2) of the rest shape and M = E h, the modulus times the thickness [N/m]. The law is neo-Hookean and
incompressible: the thickness follows the area. A membrane too thin to carry compression wrinkles. Its *relaxed* energy
(Pipkin 1986, "The relaxed energy density for isotropic elastic membranes", IMA J. Appl. Math. 36) is W where both
stresses are tensions, mu h/2 (l1^2 + 2/l1 - 3), the energy of simple tension, where the narrow side would be squeezed,
l2 < l1^-1/2, and 0 where both are slack. It is convex and never falls with l1 or l2, hence it is convex in the
positions, and its true tangent is positive semi-definite.

With the singular frame F = l1 u1 v1 + l2 u2 v2, n = u1 x u2, and g_i = dW/dl_i, the second derivative is diagonal but
for one 2 x 2 block (the 3 x 2 case of Smith, de Goes and Kim 2019, "Analytic eigensystems for isotropic distortion
energies", ACM Trans. Graph. 38):

    {u1 v1, u2 v2}:           (g11 g12; g12 g22)
    (u1 v2 + u2 v1)/sqrt2:    (g1 - g2)/(l1 - l2)         n v1:  g1/l1
    (u1 v2 - u2 v1)/sqrt2:    (g1 + g2)/(l1 + l2)         n v2:  g2/l2

An incompressible sheet has det F = 1, which is what `det_out` is.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block, matrices_at_rest
from vsfsim.physics.runtime import mat33, real, vec3

NODES = 3
_STATE = 18
"""Numbers that a tangent stores: u1, u2, n (9), v1 (2), g11, g12, g22, flip, twist, g1/l1, g2/l2."""


def block(nodes: np.ndarray, points: np.ndarray, rest: np.ndarray, modulus: np.ndarray | float) -> Block:
    """A block of membrane triangles.

    Args:
        nodes: (m, 3).
        points: positions at u = 0 (n, 3) [m], which need not be free of stress.
        rest: corners of every stress-free triangle, each in a plane of its own (m, 3, 2) [m], counter-clockwise.
        modulus: E h (m,) or one for all [N/m].
    """
    nodes = np.asarray(nodes, np.int32)
    edges = np.swapaxes(rest[:, 1:] - rest[:, :1], 1, 2)  # columns: edges from corner 0
    area = 0.5 * np.linalg.det(edges)
    modulus = np.broadcast_to(np.asarray(modulus, float), len(nodes))
    assert (area > 0.0).all() and (modulus > 0.0).all()
    return Block("triangle", nodes, {"points": points[nodes], "inverse": np.linalg.inv(edges), "area": area,
                                     "modulus": modulus.copy()})


def state_size(block: Block) -> int:
    """A tangent stores the singular frame and the second derivatives of W in it."""
    return _STATE


def rest_stiffness(block: Block) -> np.ndarray:
    """The tangent at u = 0 (m, 9, 9) [N/m]."""
    return matrices_at_rest(block)


def matrices(block: Block, state: np.ndarray) -> np.ndarray:
    """Tangent of every element (m, 9, 9) [N/m] from its stored state (m, `state_size`)."""
    u = state[:, :9].reshape(-1, 3, 3)
    v1 = state[:, 9:11]
    v = np.stack([v1, np.stack([-v1[:, 1], v1[:, 0]], axis=1)], axis=1)
    g11, g12, g22, flip, twist, along, across = state[:, 11:].T
    h = np.zeros((len(state), 3, 2, 3, 2))
    h[:, 0, 0, 0, 0], h[:, 1, 1, 1, 1], h[:, 0, 0, 1, 1], h[:, 1, 1, 0, 0] = g11, g22, g12, g12
    h[:, 0, 1, 0, 1] = h[:, 1, 0, 1, 0] = 0.5 * (flip + twist)
    h[:, 0, 1, 1, 0] = h[:, 1, 0, 0, 1] = 0.5 * (flip - twist)
    h[:, 2, 0, 2, 0], h[:, 2, 1, 2, 1] = along, across
    inverse = block.parameters["inverse"]
    # gradients of the shape functions of the three nodes (m, 3, 2)
    gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    q = np.einsum("maj,mkj->mak", gradient, v)
    w = np.einsum("mic,maj->macij", u, q)
    out = np.einsum("macij,mijkl,mbdkl->macbd", w, h, w, optimize=True).reshape(-1, 9, 9)
    return block.parameters["area"][:, None, None] * out


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    vec2 = wp.types.vector(length=2, dtype=real)
    mat22 = wp.types.matrix(shape=(2, 2), dtype=real)
    module = "vsfsim_triangle"
    tiny = wp.constant(real(1e-30))
    # within rounding of the rest state the sheet counts as taut
    slack = wp.constant(real(-1e-9))
    zero, half, one, two, three = (wp.constant(real(v)) for v in (0.0, 0.5, 1.0, 2.0, 3.0))

    class Triangles:  # see `block`
        nodes: wp.array2d(dtype=wp.int32)
        points: wp.array2d(dtype=vec3)
        inverse: wp.array(dtype=mat22)
        area: wp.array(dtype=real)
        modulus: wp.array(dtype=real)

    Triangles = wp.struct(Triangles, module=module)

    @wp.func(module=module)
    def regime(l1: real, l2: real):
        # 2: taut; 1: wrinkled; 0: slack
        out = int(2)  # noqa: UP018, RUF046  a Warp variable, not a constant
        if l1 * l2 * l2 - one < slack:
            out = 0
            if l1 > one:
                out = 1
        return out

    @wp.func(module=module)
    def law_of(l1: real, l2: real, mu: real, state: int):
        # W and its derivatives by l1 and l2
        w = zero
        g1 = zero
        g2 = zero
        if state == 2:
            j = one / (l1 * l1 * l2 * l2)
            w = half * mu * (l1 * l1 + l2 * l2 + j - three)
            g1 = mu * (l1 - j / l1)
            g2 = mu * (l2 - j / l2)
        if state == 1:
            w = half * mu * (l1 * l1 + two / l1 - three)
            g1 = mu * (l1 - one / (l1 * l1))
        return w, g1, g2

    @wp.func(module=module)
    def at(of: Triangles, x: wp.array2d(dtype=real), t: int, a: int, b: int):
        i = 3 * of.nodes[t, a]
        return vec3(x[i, b], x[i + 1, b], x[i + 2, b])

    @wp.func(module=module)
    def deformation(of: Triangles, u: wp.array2d(dtype=real), t: int, b: int):
        # the two columns of F
        x0 = of.points[t, 0] + at(of, u, t, 0, b)
        e1 = of.points[t, 1] + at(of, u, t, 1, b) - x0
        e2 = of.points[t, 2] + at(of, u, t, 2, b) - x0
        r = of.inverse[t]
        return e1 * r[0, 0] + e2 * r[1, 0], e1 * r[0, 1] + e2 * r[1, 1]

    @wp.func(module=module)
    def frame(f1: vec3, f2: vec3):
        # The singular frame (rows u1, u2, n), v1 and the two stretches.
        c11 = wp.dot(f1, f1)
        c22 = wp.dot(f2, f2)
        c12 = wp.dot(f1, f2)
        d = half * (c11 - c22)
        r = wp.sqrt(d * d + c12 * c12)
        l1 = wp.sqrt(half * (c11 + c22) + r)
        v1 = vec2(one, zero)
        if r > tiny:
            if d >= zero:
                v1 = wp.normalize(vec2(r + d, c12))
            else:
                v1 = wp.normalize(vec2(c12, r - d))
        normal = wp.cross(f1, f2)
        area = wp.length(normal)
        l2 = area / wp.max(l1, tiny)
        u1 = vec3(one, zero, zero)
        if l1 > tiny:
            u1 = wp.normalize(f1 * v1[0] + f2 * v1[1])
        # The normal of a triangle without area is arbitrary.
        n = wp.cross(u1, vec3(zero, zero, one))
        if wp.abs(u1[2]) > real(0.9):
            n = wp.cross(u1, vec3(one, zero, zero))
        if area > tiny:
            n = normal
        n = wp.normalize(n)
        u2 = wp.cross(n, u1)
        return mat33(u1[0], u1[1], u1[2], u2[0], u2[1], u2[2], n[0], n[1], n[2]), v1, l1, l2

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: Triangles,
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        f1, f2 = deformation(of, u_in, t, b)
        basis, v1, l1, l2 = frame(f1, f2)
        w, g1, g2 = law_of(l1, l2, of.modulus[t] / three, regime(l1, l2))
        u1 = vec3(basis[0, 0], basis[0, 1], basis[0, 2])
        u2 = vec3(basis[1, 0], basis[1, 1], basis[1, 2])
        p1 = of.area[t] * (g1 * v1[0] * u1 - g2 * v1[1] * u2)
        p2 = of.area[t] * (g1 * v1[1] * u1 + g2 * v1[0] * u2)
        r = of.inverse[t]
        pull1 = p1 * r[0, 0] + p2 * r[0, 1]
        pull2 = p1 * r[1, 0] + p2 * r[1, 1]
        for c in range(3):
            force_out[t, c, b] = -pull1[c] - pull2[c]
            force_out[t, 3 + c, b] = pull1[c]
            force_out[t, 6 + c, b] = pull2[c]
        energy_out[t, b] = of.area[t] * w
        det_out[t, b] = one

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        of: Triangles,
        index: wp.array(dtype=wp.int32),
        projected: int,
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        state_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        f1, f2 = deformation(of, u_in, t, b)
        basis, v1, l1, l2 = frame(f1, f2)
        mu = of.modulus[t] / three
        state = regime(l1, l2)
        _, g1, g2 = law_of(l1, l2, mu, state)
        g11 = zero
        g12 = zero
        g22 = zero
        flip = zero
        if state == 2:
            # (g1 - g2)/(l1 - l2) written without cancellation
            j = one / (l1 * l1 * l2 * l2)
            g11 = mu * (one + three * j / (l1 * l1))
            g22 = mu * (one + three * j / (l2 * l2))
            g12 = two * mu * j / (l1 * l2)
            flip = mu * (one + j / (l1 * l2))
        if state == 1:
            g11 = mu * (one + two / (l1 * l1 * l1))
            flip = g1 / (l1 - l2)
        twist = (g1 + g2) / wp.max(l1 + l2, tiny)
        along = g1 / wp.max(l1, tiny)
        across = g2 / wp.max(l2, tiny)
        if projected == 1:  # what counts as taut within rounding may be squeezed by a billionth
            twist = wp.max(twist, zero)
            along = wp.max(along, zero)
            across = wp.max(across, zero)
        for i in range(3):
            for c in range(3):
                state_out[t, 3 * i + c, b] = basis[i, c]
        state_out[t, 9, b] = v1[0]
        state_out[t, 10, b] = v1[1]
        state_out[t, 11, b] = g11
        state_out[t, 12, b] = g12
        state_out[t, 13, b] = g22
        state_out[t, 14, b] = flip
        state_out[t, 15, b] = twist
        state_out[t, 16, b] = along
        state_out[t, 17, b] = across

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: Triangles,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        d0 = at(of, x_in, t, 0, k)
        d1 = at(of, x_in, t, 1, k) - d0
        d2 = at(of, x_in, t, 2, k) - d0
        r = of.inverse[t]
        f1 = d1 * r[0, 0] + d2 * r[1, 0]
        f2 = d1 * r[0, 1] + d2 * r[1, 1]
        v = vec2(state_in[t, 9, b], state_in[t, 10, b])
        h1 = f1 * v[0] + f2 * v[1]
        h2 = f2 * v[0] - f1 * v[1]
        u1 = vec3(state_in[t, 0, b], state_in[t, 1, b], state_in[t, 2, b])
        u2 = vec3(state_in[t, 3, b], state_in[t, 4, b], state_in[t, 5, b])
        n = vec3(state_in[t, 6, b], state_in[t, 7, b], state_in[t, 8, b])
        a11 = wp.dot(u1, h1)
        a12 = wp.dot(u1, h2)
        a21 = wp.dot(u2, h1)
        a22 = wp.dot(u2, h2)
        g12 = state_in[t, 12, b]
        even = half * state_in[t, 14, b] * (a12 + a21)
        odd = half * state_in[t, 15, b] * (a12 - a21)
        q1 = (state_in[t, 11, b] * a11 + g12 * a22) * u1 + (even - odd) * u2 + (state_in[t, 16, b] * wp.dot(n, h1)) * n
        q2 = (even + odd) * u1 + (g12 * a11 + state_in[t, 13, b] * a22) * u2 + (state_in[t, 17, b] * wp.dot(n, h2)) * n
        p1 = of.area[t] * (q1 * v[0] - q2 * v[1])
        p2 = of.area[t] * (q1 * v[1] + q2 * v[0])
        pull1 = p1 * r[0, 0] + p2 * r[0, 1]
        pull2 = p1 * r[1, 0] + p2 * r[1, 1]
        for c in range(3):
            force_out[t, c, k] = -pull1[c] - pull2[c]
            force_out[t, 3 + c, k] = pull1[c]
            force_out[t, 6 + c, k] = pull2[c]

    return SimpleNamespace(forces=forces, tangent=tangent, multiply=multiply, arguments=Triangles)
