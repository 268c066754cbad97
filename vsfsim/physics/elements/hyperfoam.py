"""Quadratic tetrahedron of a compressible foam: the hyperfoam law of Ogden and Storåkers, of up to two terms.

    Psi = sum_i 2 mu_i / alpha_i^2 [ l1^alpha_i + l2^alpha_i + l3^alpha_i - 3 + (J^(-alpha_i beta_i) - 1) / beta_i ]

with the principal stretches l and J = l1 l2 l3; for beta_i = 0 the last term is -alpha_i ln J (Storåkers 1986, "On
material representation and constitutive branching in finite compressible elasticity"; Ogden 1972). At small strains mu
= sum mu_i and lambda = sum 2 mu_i beta_i. Everything is multiplied by ``scale`` at each Gauss point, which is the ratio
of the local modulus to the material's own.

Below J = `CRUSHED` the term of J, and below l = `THIN` the terms of l, are continued by their Taylor polynomials of
second order, so that inverted elements have a finite energy; frames with J < `CRUSHED` are marked.

With F = U diag(l) V^T (l3 < 0 in an inverted element) the tangent acts on X = U^T dF V (Smith, de Goes and Kim 2019):
the 3 x 3 block Psi_ab on its diagonal, (Psi_a - Psi_b)/(l_a - l_b) on the symmetric part of each pair (a, b) and (Psi_a
+ Psi_b)/(l_a + l_b) on the skew part. The projected tangent sets negative eigenvalues of each to zero.

The shape functions are those of `tet10`: ten nodes, straight sides, four Gauss points.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.scene_tables.foam import Foam
from vsfsim.physics.elements import principal, tet10, tet10_shape
from vsfsim.physics.elements.block import Block
from vsfsim.physics.elements.neo_hooke import CRUSHED

NODES = 10
TERMS = 2
THIN = 0.02
"""Principal stretch below which a power of it is continued by a polynomial [-]."""
_STORED = 30  # of a Gauss point: U, V, the block of the stretches (6), symmetric and skew parts (6)


def block(nodes: np.ndarray, gradients: np.ndarray, volume: np.ndarray, scale: np.ndarray, foam: Foam) -> Block:
    """A block of quadratic tetrahedra of a foam.

    Args:
        nodes: (m, 10), corners then edges.
        gradients: of the barycentric coordinates (m, 4, 3) [1/m].
        volume: (m,) [m^3].
        scale: factor on all moduli at the Gauss points (m, 4) [-].
        foam: the material.
    """
    assert len(foam.mu) <= TERMS
    terms = np.zeros((TERMS, 3))
    terms[:, 1] = 1.0  # alpha of a term that is not used
    terms[:len(foam.mu)] = np.column_stack([foam.mu, foam.alpha, foam.beta])
    return Block("hyperfoam", np.asarray(nodes, np.int32), {
        "gradients": gradients, "volume": volume, "scale": scale, "terms": terms})


def state_size(block: Block) -> int:
    """U, V and the tangent in the principal frame at each Gauss point."""
    return 4 * _STORED


def rest_stiffness(block: Block) -> np.ndarray:
    """Element stiffness at rest (m, 30, 30) [N/m], that of `tet10` with the same (mu, lambda)."""
    p = block.parameters
    mu, _, beta = p["terms"].T
    return tet10.rest_stiffness(tet10.block(block.nodes, p["gradients"], p["volume"], mu.sum() * p["scale"],
                                            2.0 * (mu * beta).sum() * p["scale"], pointwise=np.inf))


@functools.cache
def kernels(real: type) -> Any:
    """The kernels of this element for one scalar type (`wp.float32` or `wp.float64`)."""
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat103 = wp.types.matrix(shape=(10, 3), dtype=real)
    module = f"vsfsim_hyperfoam_{real.__name__}"
    shape = tet10_shape.functions(real, module)
    load, edge_sums, gradient, stresses, spread, finish = (
        shape.load, shape.edge_sums, shape.gradient, shape.stresses, shape.spread, shape.finish)
    frame = principal.functions(real, module)
    eigen, decompose = frame.eigen, frame.decompose
    crushed, thin = wp.constant(real(CRUSHED)), wp.constant(real(THIN))
    # difference of two stretches below which their difference quotient is the mean of the derivatives
    near = wp.constant(real(1e-5 if real is wp.float64 else 1e-2))

    @wp.func(module=module)
    def exp_rest(y: real):
        # exp(y) - 1 - y
        if wp.abs(y) > real(0.5):
            return wp.exp(y) - real(1.0) - y
        tail = real(1.0)
        for n in range(13):
            tail = real(1.0) + tail * y / real(15 - n)
        return real(0.5) * y * y * tail

    @wp.func(module=module)
    def power(lam: real, e: real):
        # lam^e, its slope and curvature over 2, continued below `thin`
        a = wp.max(lam, thin)
        v = wp.pow(a, e)
        s = e * v / a
        c = e * (e - real(1.0)) * v / (a * a)
        d = lam - a
        return v + s * d + real(0.5) * c * d * d, s + c * d, c

    @wp.func(module=module)
    def bulk(j: real, alpha: real, beta: real):
        # (J^(-alpha beta) - 1)/beta or -alpha ln J, its slope and curvature, continued below `crushed`
        a = wp.max(j, crushed)
        v = -alpha * wp.log(a)
        p = real(1.0)
        if wp.abs(beta) > real(1e-12):
            p = wp.pow(a, -alpha * beta)
            v = (p - real(1.0)) / beta
        s = -alpha * p / a
        c = alpha * (alpha * beta + real(1.0)) * p / (a * a)
        d = j - a
        return v + s * d + real(0.5) * c * d * d, s + c * d, c

    @wp.func(module=module)
    def regular(lam: vec3):
        return lam[2] >= thin and lam[0] * lam[1] * lam[2] >= crushed

    @wp.func(module=module)
    def energy_of(x: vec3, lam: vec3, terms: wp.array2d(dtype=real)):
        total = real(0.0)
        for i in range(TERMS):
            mu = terms[i, 0]
            alpha = terms[i, 1]
            beta = terms[i, 2]
            part = real(0.0)
            if regular(lam):
                # alpha (ln l1 + ln l2 + ln l3 - ln J) = 0 is left out, so that no term is of first order
                part = exp_rest(alpha * x[0]) + exp_rest(alpha * x[1]) + exp_rest(alpha * x[2])
                if wp.abs(beta) > real(1e-12):
                    part += exp_rest(-alpha * beta * (x[0] + x[1] + x[2])) / beta
            else:
                value, _, _ = bulk(lam[0] * lam[1] * lam[2], alpha, beta)
                part = value - real(3.0)
                for k in range(3):
                    value, _, _ = power(lam[k], alpha)
                    part += value
            total += real(2.0) * mu / (alpha * alpha) * part
        return total

    @wp.func(module=module)
    def slopes(x: vec3, lam: vec3, terms: wp.array2d(dtype=real)):
        # dPsi/dl
        out = vec3()
        for i in range(TERMS):
            alpha = terms[i, 1]
            beta = terms[i, 2]
            scale = real(2.0) * terms[i, 0] / alpha
            if regular(lam):
                y = -alpha * beta * (x[0] + x[1] + x[2])
                for k in range(3):
                    z = alpha * x[k]
                    out[k] = out[k] + scale * (exp_rest(z) + z - exp_rest(y) - y) / lam[k]
            else:
                _, s, _ = bulk(lam[0] * lam[1] * lam[2], alpha, beta)
                p = vec3(lam[1] * lam[2], lam[2] * lam[0], lam[0] * lam[1])
                for k in range(3):
                    _, t, _ = power(lam[k], alpha)
                    out[k] = out[k] + scale / alpha * (t + s * p[k])
        return out

    @wp.func(module=module)
    def curvatures(lam: vec3, terms: wp.array2d(dtype=real)):
        # d2Psi/dl dl
        out = mat33()
        p = vec3(lam[1] * lam[2], lam[2] * lam[0], lam[0] * lam[1])
        for i in range(TERMS):
            alpha = terms[i, 1]
            scale = real(2.0) * terms[i, 0] / (alpha * alpha)
            _, s, c = bulk(lam[0] * lam[1] * lam[2], alpha, terms[i, 2])
            out += (scale * c) * wp.outer(p, p)
            for k in range(3):
                _, _, bend = power(lam[k], alpha)
                out[k, k] = out[k, k] + scale * bend
            for a in range(3):
                for b in range(3):
                    if a != b:
                        out[a, b] = out[a, b] + scale * s * lam[3 - a - b]
        return out

    @wp.func(module=module)
    def pair(lam: vec3, w: vec3, h: mat33, a: int, b: int):
        # stiffness of the symmetric and of the skew part of the pair (a, b)
        difference = lam[a] - lam[b]
        even = real(0.5) * (h[a, a] + h[b, b]) - h[a, b]
        if wp.abs(difference) > near:
            even = (w[a] - w[b]) / difference
        total = lam[a] + lam[b]
        if wp.abs(total) < real(1e-9):
            total = real(1e-9)
        return even, (w[a] + w[b]) / total

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        gradients: wp.array(dtype=mat33),
        volume: wp.array(dtype=real),
        scale: wp.array2d(dtype=real),
        terms: wp.array2d(dtype=real),
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
        x = load(nodes, u_in, t, b)
        s = edge_sums(x)
        g = gradients[t]
        weight = real(0.25) * volume[t]
        energy = real(0.0)
        lowest = real(1e30)
        force = mat103()
        total = mat43()
        for q in range(4):
            logs, lam, u, v = decompose(gradient(x, s, g, q))
            energy += scale[t, q] * energy_of(logs, lam, terms)
            w = slopes(logs, lam, terms)
            lowest = wp.min(lowest, lam[0] * lam[1] * lam[2])
            p = (weight * scale[t, q]) * (u * wp.diag(w) * wp.transpose(v))
            stress = stresses(p, g)
            total += stress
            force = spread(force, stress, q)
        force = finish(force, total)
        for a in range(10):
            for c in range(3):
                force_out[t, 3 * a + c, b] = force[a, c]
        energy_out[t, b] = weight * energy
        det_out[t, b] = lowest

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        gradients: wp.array(dtype=mat33),
        volume: wp.array(dtype=real),
        scale: wp.array2d(dtype=real),
        terms: wp.array2d(dtype=real),
        index: wp.array(dtype=wp.int32),
        projected: int,
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        state_out: wp.array3d(dtype=real),
    ):
        # at each Gauss point: U and V (18), the block of the stretches (00 01 02 11 12 22), the symmetric and the skew
        # parts of the pairs (0, 1), (1, 2), (2, 0)
        t, k = wp.tid()
        n = index[k]
        x = load(nodes, u_in, t, n)
        s = edge_sums(x)
        weight = real(0.25) * volume[t]
        for q in range(4):
            logs, lam, u, v = decompose(gradient(x, s, gradients[t], q))
            w = slopes(logs, lam, terms)
            h = curvatures(lam, terms)
            even = vec3()
            odd = vec3()
            for a in range(3):
                e, o = pair(lam, w, h, a, (a + 1) % 3)
                even[a] = e
                odd[a] = o
            if projected == 1:
                values, axes = eigen(h)
                h = axes * wp.diag(wp.max(values, vec3())) * wp.transpose(axes)
                even = wp.max(even, vec3())
                odd = wp.max(odd, vec3())
            size = weight * scale[t, q]
            at = _STORED * q
            for a in range(3):
                for c in range(3):
                    state_out[t, at + 3 * a + c, n] = u[a, c]
                    state_out[t, at + 9 + 3 * a + c, n] = v[a, c]
                state_out[t, at + 24 + a, n] = size * even[a]
                state_out[t, at + 27 + a, n] = size * odd[a]
            state_out[t, at + 18, n] = size * h[0, 0]
            state_out[t, at + 19, n] = size * h[0, 1]
            state_out[t, at + 20, n] = size * h[0, 2]
            state_out[t, at + 21, n] = size * h[1, 1]
            state_out[t, at + 22, n] = size * h[1, 2]
            state_out[t, at + 23, n] = size * h[2, 2]

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        gradients: wp.array(dtype=mat33),
        volume: wp.array(dtype=real),
        scale: wp.array2d(dtype=real),
        terms: wp.array2d(dtype=real),
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        n = index[k]
        x = load(nodes, x_in, t, k)
        xs = edge_sums(x)
        g = gradients[t]
        force = mat103()
        total = mat43()
        for q in range(4):
            at = _STORED * q
            u = mat33()
            v = mat33()
            for a in range(3):
                for c in range(3):
                    u[a, c] = state_in[t, at + 3 * a + c, n]
                    v[a, c] = state_in[t, at + 9 + 3 * a + c, n]
            d = wp.transpose(u) * gradient(x, xs, g, q) * v
            y = mat33()
            y[0, 0] = (state_in[t, at + 18, n] * d[0, 0] + state_in[t, at + 19, n] * d[1, 1]
                       + state_in[t, at + 20, n] * d[2, 2])
            y[1, 1] = (state_in[t, at + 19, n] * d[0, 0] + state_in[t, at + 21, n] * d[1, 1]
                       + state_in[t, at + 22, n] * d[2, 2])
            y[2, 2] = (state_in[t, at + 20, n] * d[0, 0] + state_in[t, at + 22, n] * d[1, 1]
                       + state_in[t, at + 23, n] * d[2, 2])
            for a in range(3):
                c = (a + 1) % 3
                even = real(0.5) * state_in[t, at + 24 + a, n] * (d[a, c] + d[c, a])
                odd = real(0.5) * state_in[t, at + 27 + a, n] * (d[a, c] - d[c, a])
                y[a, c] = even + odd
                y[c, a] = even - odd
            stress = stresses(u * y * wp.transpose(v), g)
            total += stress
            force = spread(force, stress, q)
        force = finish(force, total)
        for a in range(10):
            for c in range(3):
                force_out[t, 3 * a + c, k] = force[a, c]

    def parameters(block: Block, device: str) -> list[wp.array]:
        p = block.parameters
        return [wp.array(p["gradients"][:, 1:], dtype=mat33, device=device),
                *(wp.array(p[name], dtype=real, device=device) for name in ("volume", "scale", "terms"))]

    return SimpleNamespace(forces=forces, tangent=tangent, multiply=multiply, parameters=parameters, shared=(3,))
