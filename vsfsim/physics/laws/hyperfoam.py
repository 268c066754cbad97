"""Compressible foam: the hyperfoam law of Ogden and Storåkers, of up to two terms.

    Psi = sum_i 2 mu_i / alpha_i^2 [ l1^alpha_i + l2^alpha_i + l3^alpha_i - 3 + (J^(-alpha_i beta_i) - 1) / beta_i ]

with the principal stretches l and J = l1 l2 l3; for beta_i = 0 the last term is -alpha_i ln J (Storåkers 1986, "On
material representation and constitutive branching in finite compressible elasticity"; Ogden 1972). At small strains mu
= sum mu_i and lambda = sum 2 mu_i beta_i. Everything is multiplied by ``scale`` at each Gauss point, which is the ratio
of the local modulus to the material's own.

Below J = `CRUSHED` the term of J, and below l = `THIN` the terms of l, are continued by their Taylor polynomials of
second order, so that inverted elements have a finite energy; frames with J < `CRUSHED` are marked.
"""

from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.errors import SceneError
from vsfsim.core.material import Foam
from vsfsim.physics.laws import principal
from vsfsim.physics.laws.law import Settings, SolidLaw
from vsfsim.physics.laws.neo_hooke import CRUSHED
from vsfsim.physics.runtime import mat33, real, vec3

TERMS = 2
THIN = 0.02
"""Principal stretch below which a power of it is continued by a polynomial [-]."""


def settings_of(foam: Foam) -> Settings:
    """The rows of numbers of a foam."""
    return {"mu": foam.mu, "alpha": foam.alpha, "beta": foam.beta}


def parameters(mu: np.ndarray, lam: np.ndarray, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """The scale of every point [-], and mu [Pa], alpha and beta of each term.

    Raises:
        SceneError: more than `TERMS` terms, rows that differ in length, or another lambda / mu.
    """
    rows = [np.atleast_1d(np.asarray(settings[name], float)) for name in LAW.settings]
    if len({len(row) for row in rows}) != 1 or not 1 <= len(rows[0]) <= TERMS:
        raise SceneError(f"law 'hyperfoam' takes mu, alpha and beta of one or {TERMS} terms, in three rows of "
                         f"one length.")
    ratio = 2.0 * float(rows[0] @ rows[2]) / float(rows[0].sum())
    if not np.allclose(lam, ratio * mu, rtol=1e-6, atol=1e-9 * mu.max()):
        raise SceneError(f"law 'hyperfoam': with these mu and beta Poisson's ratio is "
                         f"{0.5 * ratio / (1.0 + ratio):.6g}; give poisson_ratio = {0.5 * ratio / (1.0 + ratio):.6g}.")
    terms = np.zeros((TERMS, 3))
    terms[:, 1] = 1.0  # alpha of a term that is not used
    terms[:len(rows[0])] = np.column_stack(rows)
    return (mu / rows[0].sum())[:, :, None], terms


def functions(module: str) -> Any:
    """See `law.SolidLaw`."""
    exp_rest, crushed, thin = principal.exp_rest(module), wp.constant(real(CRUSHED)), wp.constant(real(THIN))

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
    def energy(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
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
        return own[t, q, 0] * total

    @wp.func(module=module)
    def slopes(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
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
                    _, bend, _ = power(lam[k], alpha)
                    out[k] = out[k] + scale / alpha * (bend + s * p[k])
        return own[t, q, 0] * out

    @wp.func(module=module)
    def curvatures(lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
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
        return own[t, q, 0] * out

    return principal.functions_of(energy, slopes, curvatures, module)


LAW = SolidLaw("hyperfoam", principal.STORED, functions, parameters, settings=("mu", "alpha", "beta"))
