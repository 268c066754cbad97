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
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block, element_kernels, struct_of
from vsfsim.physics.runtime import mat33, real, vec3

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


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    vec2, vec9 = (wp.types.vector(length=n, dtype=real) for n in (2, 9))
    mat22, mat32 = (wp.types.matrix(shape=(n, 2), dtype=real) for n in (2, 3))
    module = "vsfsim_triangle"
    tiny = wp.constant(real(1e-30))
    # within rounding of the rest state the sheet counts as taut
    slack = wp.constant(real(-1e-9))
    zero, half, one, two, three = (wp.constant(real(v)) for v in (0.0, 0.5, 1.0, 2.0, 3.0))
    arguments = struct_of(module, points=wp.array(dtype=mat33), inverse=wp.array(dtype=mat22),
                          area=wp.array(dtype=real), modulus=wp.array(dtype=real))

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
    def deformation(of: arguments, x: mat33, t: int):
        # F for the corners x, one a row
        return wp.matrix_from_cols(x[1] - x[0], x[2] - x[0]) * of.inverse[t]

    @wp.func(module=module)
    def nodal_forces(of: arguments, stress: mat32, t: int):
        # the transpose of `deformation`
        pull = of.area[t] * (stress * wp.transpose(of.inverse[t]))
        out = mat33()
        for c in range(3):
            out[0, c] = -pull[c, 0] - pull[c, 1]
            out[1, c] = pull[c, 0]
            out[2, c] = pull[c, 1]
        return out

    @wp.func(module=module)
    def frame(f: mat32):
        # the singular frame (rows u1, u2, n), its two directions at rest (columns v1, v2) and the two stretches
        f1 = vec3(f[0, 0], f[1, 0], f[2, 0])
        f2 = vec3(f[0, 1], f[1, 1], f[2, 1])
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
        u1 = vec3(one, zero, zero)
        if l1 > tiny:
            u1 = wp.normalize(f * v1)
        # The normal of a triangle without area is arbitrary.
        n = wp.cross(u1, vec3(zero, zero, one))
        if wp.abs(u1[2]) > real(0.9):
            n = wp.cross(u1, vec3(one, zero, zero))
        if area > tiny:
            n = normal
        n = wp.normalize(n)
        turn = mat22(v1[0], -v1[1], v1[1], v1[0])
        return wp.matrix_from_rows(u1, wp.cross(n, u1), n), turn, l1, area / wp.max(l1, tiny)

    @wp.func(module=module)
    def respond(of: arguments, u: mat33, t: int):
        basis, turn, l1, l2 = frame(deformation(of, of.points[t] + u, t))
        w, g1, g2 = law_of(l1, l2, of.modulus[t] / three, regime(l1, l2))
        stress = wp.transpose(basis) * mat32(g1, zero, zero, g2, zero, zero) * wp.transpose(turn)
        return nodal_forces(of, stress, t), of.area[t] * w, one

    @wp.func(module=module)
    def linearise(of: arguments, u: mat33, t: int, b: int, projected: int, state_out: wp.array3d(dtype=real)):
        basis, turn, l1, l2 = frame(deformation(of, of.points[t] + u, t))
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
        values = vec9(turn[0, 0], turn[1, 0], g11, g12, g22, flip, twist, along, across)
        for i in range(9):
            state_out[t, i, b] = basis[i // 3, i % 3]
            state_out[t, 9 + i, b] = values[i]

    @wp.func(module=module)
    def multiply(of: arguments, u: mat33, x: mat33, t: int, b: int, state_in: wp.array3d(dtype=real)):
        basis = mat33()
        s = vec9()
        for i in range(9):
            basis[i // 3, i % 3] = state_in[t, i, b]
            s[i] = state_in[t, 9 + i, b]
        turn = mat22(s[0], -s[1], s[1], s[0])
        a = basis * deformation(of, x, t) * turn
        even = half * s[5] * (a[0, 1] + a[1, 0])
        odd = half * s[6] * (a[0, 1] - a[1, 0])
        q = mat32(s[2] * a[0, 0] + s[3] * a[1, 1], even + odd, even - odd, s[3] * a[0, 0] + s[4] * a[1, 1],
                  s[7] * a[2, 0], s[8] * a[2, 1])
        return nodal_forces(of, wp.transpose(basis) * q * wp.transpose(turn), t)

    return element_kernels(module, arguments, 3, respond=respond, multiply=multiply, linearise=linearise)
