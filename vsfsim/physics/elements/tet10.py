"""Quadratic tetrahedron, stable neo-Hookean.

    Psi(F) = mu/2 (|F|^2 - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2,     J = det F

Smith, de Goes and Kim, "Stable neo-Hookean flesh simulation" (2018), without the origin barrier and with the rest state
moved back to F = I, so that small strains give exactly (mu, lambda) of linear elasticity. Finite at J <= 0: an
inverted element has a finite energy and a force that turns it back.
P = mu F + c cof F with c = (lambda + mu)(J - 1) - mu. The Hessian is projected to a positive semi-definite one with
its eigen-system in closed form (Smith, de Goes and Kim, "Analytic eigensystems for isotropic distortion energies", 2019):
twists mu + c s_k, flips mu - c s_k, and a 3 x 3 block for the stretches, with s_k the singular values of F.
The projection costs the quadratic convergence of Newton's method in bent or compressed parts, so the Hessian can also be had as it is.

Ten nodes (corners 0-3, then the edges of `EDGES`), straight sides, four Gauss points, moduli per Gauss point.
Vectors are (3 n, B): degree of freedom by touch; node i owns rows 3 i, 3 i + 1, 3 i + 2.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly

EDGES = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
GAUSS_NEAR = (5.0 + 3.0 * np.sqrt(5.0)) / 20.0  # barycentric coordinate of the corner that a Gauss point is nearest to
GAUSS_FAR = (5.0 - np.sqrt(5.0)) / 20.0


@functools.cache
def kernels(real: type) -> Any:
    """The kernels of this element for one scalar type (`wp.float32` or `wp.float64`)."""
    vec3 = wp.types.vector(length=3, dtype=real)
    vec4 = wp.types.vector(length=4, dtype=real)
    vec9 = wp.types.vector(length=9, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat99 = wp.types.matrix(shape=(9, 9), dtype=real)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat103 = wp.types.matrix(shape=(10, 3), dtype=real)
    near = wp.constant(real(GAUSS_NEAR))
    far = wp.constant(real(GAUSS_FAR))
    half_root = wp.constant(real(np.sqrt(0.5)))
    module = f"vsfsim_tet10_{real.__name__}"

    @wp.func(module=module)
    def load(nodes: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=real), t: int, b: int):
        out = mat103()
        for a in range(10):
            row = 3 * nodes[t, a]
            for c in range(3):
                out[a, c] = x[row + c, b]
        return out

    @wp.func(module=module)
    def gauss(q: int):
        # barycentric coordinates of Gauss point q
        out = vec4(far, far, far, far)
        for k in range(4):
            if k == q:
                out[k] = near
        return out

    @wp.func(module=module)
    def corner_sums(x: mat103, q: int):
        # sum_a x_a dN_a/dL_k for the four barycentric coordinates L_k: gradients of N in two cheap steps
        out = mat43()
        b = gauss(q)
        four = real(4.0)
        one = real(1.0)
        for c in range(3):
            out[0, c] = (four * b[0] - one) * x[0, c] + four * (b[1] * x[4, c] + b[2] * x[6, c] + b[3] * x[7, c])
            out[1, c] = (four * b[1] - one) * x[1, c] + four * (b[0] * x[4, c] + b[2] * x[5, c] + b[3] * x[8, c])
            out[2, c] = (four * b[2] - one) * x[2, c] + four * (b[1] * x[5, c] + b[0] * x[6, c] + b[3] * x[9, c])
            out[3, c] = (four * b[3] - one) * x[3, c] + four * (b[0] * x[7, c] + b[1] * x[8, c] + b[2] * x[9, c])
        return out

    @wp.func(module=module)
    def spread(f: mat103, t: mat43, q: int):
        # the transpose of corner_sums, added to f
        b = gauss(q)
        four = real(4.0)
        one = real(1.0)
        for c in range(3):
            for k in range(4):
                f[k, c] += (four * b[k] - one) * t[k, c]
            f[4, c] += four * (b[1] * t[0, c] + b[0] * t[1, c])
            f[5, c] += four * (b[2] * t[1, c] + b[1] * t[2, c])
            f[6, c] += four * (b[0] * t[2, c] + b[2] * t[0, c])
            f[7, c] += four * (b[3] * t[0, c] + b[0] * t[3, c])
            f[8, c] += four * (b[3] * t[1, c] + b[1] * t[3, c])
            f[9, c] += four * (b[3] * t[2, c] + b[2] * t[3, c])
        return f

    @wp.func(module=module)
    def cofactor(f: mat33):
        c0 = vec3(f[0, 0], f[1, 0], f[2, 0])
        c1 = vec3(f[0, 1], f[1, 1], f[2, 1])
        c2 = vec3(f[0, 2], f[1, 2], f[2, 2])
        g0 = wp.cross(c1, c2)
        g1 = wp.cross(c2, c0)
        g2 = wp.cross(c0, c1)
        return mat33(g0[0], g1[0], g2[0], g0[1], g1[1], g2[1], g0[2], g1[2], g2[2])

    @wp.func(module=module)
    def add_mode(h: mat99, e: mat33, value: real):
        # h += value e e^T, with e flattened row by row
        v = vec9(e[0, 0], e[0, 1], e[0, 2], e[1, 0], e[1, 1], e[1, 2], e[2, 0], e[2, 1], e[2, 2])
        return h + wp.outer(v, value * v)

    @wp.func(module=module)
    def dyad(u: mat33, v: mat33, i: int, j: int):
        return wp.outer(vec3(u[0, i], u[1, i], u[2, i]), vec3(v[0, j], v[1, j], v[2, j]))

    @wp.func(module=module)
    def hessian(f: mat33, mu: real, lam: real, zero: real):
        u, s, v = wp.svd3(f)
        sign = wp.determinant(u) * wp.determinant(v)
        j = sign * s[0] * s[1] * s[2]
        bulk = lam + mu
        c = bulk * (j - real(1.0)) - mu
        h = mat99()
        for k in range(3):
            i1 = (k + 1) % 3
            i2 = (k + 2) % 3
            a = half_root * dyad(u, v, i1, i2)
            b = half_root * dyad(u, v, i2, i1)
            twist = wp.max(mu + c * sign * s[k], zero)
            flip = wp.max(mu - c * sign * s[k], zero)
            h = add_mode(h, a - b, twist)
            h = add_mode(h, a + b, flip)
        p0 = s[1] * s[2]
        p1 = s[2] * s[0]
        p2 = s[0] * s[1]
        a01 = bulk * p0 * p1 + c * sign * s[2]
        a02 = bulk * p0 * p2 + c * sign * s[1]
        a12 = bulk * p1 * p2 + c * sign * s[0]
        block = mat33(mu + bulk * p0 * p0, a01, a02, a01, mu + bulk * p1 * p1, a12, a02, a12, mu + bulk * p2 * p2)
        vectors, values = wp.eig3(block)
        d0 = dyad(u, v, 0, 0)
        d1 = dyad(u, v, 1, 1)
        d2 = dyad(u, v, 2, 2)
        for m in range(3):
            mode = vectors[0, m] * d0 + vectors[1, m] * d1 + vectors[2, m] * d2
            h = add_mode(h, mode, wp.max(values[m], zero))
        return h

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        gradients: wp.array(dtype=mat43),
        volume: wp.array(dtype=real),
        mu: wp.array2d(dtype=real),
        lam: wp.array2d(dtype=real),
        with_hessian: int,  # 0 none, 1 projected to positive semi-definite, 2 as it is
        columns: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=vec3),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
        hessian_out: wp.array3d(dtype=mat99),
    ):
        t, k = wp.tid()
        b = columns[k]
        x = load(nodes, u_in, t, b)
        g = gradients[t]
        force = mat103()
        energy = real(0.0)
        least = real(1e30)
        weight = real(0.25) * volume[t]
        for q in range(4):
            # displacement gradient rather than F, so that the energy of small strains keeps its digits
            d = wp.transpose(corner_sums(x, q)) * g
            f = d
            for c in range(3):
                f[c, c] += real(1.0)
            m = mu[t, q]
            cof = cofactor(f)
            trace = d[0, 0] + d[1, 1] + d[2, 2]
            # J - 1 = tr D + (second invariant of D) + det D, without cancellation
            second = (
                d[0, 0] * d[1, 1] + d[1, 1] * d[2, 2] + d[2, 2] * d[0, 0]
                - d[0, 1] * d[1, 0] - d[1, 2] * d[2, 1] - d[2, 0] * d[0, 2]
            )
            j1 = trace + second + wp.determinant(d)
            stiff = lam[t, q] + m
            # mu/2 (|F|^2 - 3) - mu (J - 1) = mu (|D|^2/2 - second - det D)
            energy += weight * (
                m * (real(0.5) * wp.ddot(d, d) - (j1 - trace)) + real(0.5) * stiff * j1 * j1
            )
            # P = mu F + c cof F = mu (F - cof F) + (lambda + mu) (J - 1) cof F
            p = m * (f - cof) + stiff * j1 * cof
            least = wp.min(least, real(1.0) + j1)
            force = spread(force, (weight * g) * wp.transpose(p), q)
            if with_hessian > 0:
                least_eigenvalue = real(0.0)
                if with_hessian == 2:
                    least_eigenvalue = real(-1e30)
                hessian_out[t, q, b] = weight * hessian(f, m, lam[t, q], least_eigenvalue)
        for a in range(10):
            force_out[t, a, b] = vec3(force[a, 0], force[a, 1], force[a, 2])
        energy_out[t, b] = energy
        det_out[t, b] = least

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        gradients: wp.array(dtype=mat43),
        columns: wp.array(dtype=wp.int32),
        # state in
        hessian_in: wp.array3d(dtype=mat99),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=vec3),
    ):
        # x_in has one column for each entry of `columns`; hessians and element forces lie at the touch's own column
        t, k = wp.tid()
        b = columns[k]
        x = load(nodes, x_in, t, k)
        g = gradients[t]
        force = mat103()
        for q in range(4):
            d = wp.transpose(corner_sums(x, q)) * g
            v = vec9(d[0, 0], d[0, 1], d[0, 2], d[1, 0], d[1, 1], d[1, 2], d[2, 0], d[2, 1], d[2, 2])
            w = hessian_in[t, q, b] * v
            p = mat33(w[0], w[1], w[2], w[3], w[4], w[5], w[6], w[7], w[8])
            force = spread(force, g * wp.transpose(p), q)
        for a in range(10):
            force_out[t, a, b] = vec3(force[a, 0], force[a, 1], force[a, 2])

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        # model
        start: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        free: wp.array(dtype=real),
        columns: wp.array(dtype=wp.int32),
        compact: int,
        # state in
        element_in: wp.array3d(dtype=vec3),
        # state out
        node_out: wp.array2d(dtype=real),
    ):
        # per node, in a fixed order: the sum is the same on every run, which atomics would not promise
        i, k = wp.tid()
        b = columns[k]
        total = vec3()
        for s in range(start[i], start[i + 1]):
            code = slot[s]
            total += element_in[code // 10, code % 10, b]
        at = b
        if compact == 1:
            at = k
        for c in range(3):
            node_out[3 * i + c, at] = total[c] * free[3 * i + c]

    @wp.kernel(module=module, enable_backward=False)
    def summarise(
        # model
        columns: wp.array(dtype=wp.int32),
        # state in
        energy_in: wp.array2d(dtype=real),
        det_in: wp.array2d(dtype=real),
        # state out
        energy_out: wp.array(dtype=wp.float64),
        det_out: wp.array(dtype=real),
    ):
        b = columns[wp.tid()]
        total = wp.float64(0.0)
        least = real(1e30)
        for t in range(energy_in.shape[0]):
            total += wp.float64(energy_in[t, b])
            least = wp.min(least, det_in[t, b])
        energy_out[b] = total
        det_out[b] = least

    class Kernels:
        pass

    out = Kernels()
    out.evaluate, out.multiply, out.gather, out.summarise = evaluate, multiply, gather, summarise
    out.real, out.vec3, out.mat43, out.mat99 = real, vec3, mat43, mat99
    return out
