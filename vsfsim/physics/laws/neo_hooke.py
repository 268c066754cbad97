"""Compressible neo-Hookean law with a barrier on the volume, and the projection of its tangent.

    Psi(F) = mu/2 (|F|^2 - 3) + U(J),     U(J) = lambda/2 (J - 1)^2 - mu f(J),     J = det F
    f(J) = ln J for J >= `CRUSHED`, and below it the Taylor polynomial of second order of ln J about `CRUSHED`

Above J = `CRUSHED` this is the law of Bonet and Wood ("Nonlinear continuum mechanics for finite element analysis", 2nd
edition 2008, section 6.4.3) with the volumetric term (J - 1)^2 of Simo, Taylor and Pister (1985). Small strains give
exactly (mu, lambda) of linear elasticity. The logarithm is a barrier: the force of a compression grows without bound as
the volume goes to zero. Below `CRUSHED`, a tenth of the volume, the continuation makes energy, force and tangent finite
and continuous, so that Newton's method recovers from an inverted element (J < 0); frames with such an element are
marked. U is convex for every J, which makes the energy polyconvex.

With kappa = U''(J) and c = U'(J), to which an element adds a pressure of its own, the tangent is

    H = mu I + kappa cof F (x) cof F + c d(cof F)/dF.

The first two terms are positive semi-definite; the third makes it indefinite where |c| is large. With A = F^-1 dF,

    dF : H dF = mu |F A|^2 + (kappa J^2 + c J) (tr A)^2 - c J (|sym A|^2 - |skew A|^2),

so under pressure (c < 0 < J), where only twists and changes of volume can be negative, the projected tangent adds tau
|skew A|^2 and enlarges kappa, both by the least amounts that leave no eigenvalue negative. Elsewhere (tension, or an
inverted element) c is replaced by theta c with theta = mu / (2 |c| s_0) where that is less than 1: the eigenvalues of
d(cof F)/dF are +- s_k for twists and flips, with s_k the singular values of F, and 2 s_0 at most for changes of stretch
(Smith, de Goes and Kim, "Analytic eigensystems for isotropic distortion energies", 2019). Under pressure
theta c would not do: it takes away what c adds to the stiffness of every other mode, a factor of 1/J. A tangent stores
c, kappa and tau / J^2.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements import deformation
from vsfsim.physics.laws.law import Settings, SolidLaw
from vsfsim.physics.runtime import mat33, real, vec3

CRUSHED = 0.1
"""det F below which the logarithm is continued by a polynomial [-]."""
_FLAT = 0.02  # det F below which the projected tangent is that of an inverted element: its formulas do not divide by J


def functions(module: str) -> Any:
    """See `law.SolidLaw`."""
    kinematics = deformation.functions(module)
    deform, cofactor, cofactor_change, volume_change, singular = (
        kinematics.gradient, kinematics.cofactor, kinematics.cofactor_change, kinematics.volume_change,
        kinematics.squares)
    least, log_least = wp.constant(real(CRUSHED)), wp.constant(real(np.log(CRUSHED)))
    flat = wp.constant(real(_FLAT))

    @wp.func(module=module)
    def barrier(j1: real):
        # (J - 1) - f(J) and its derivative from J - 1. The value is of second order in J - 1; near J = 1 the series
        # ln J = 2 (s + s^3/3 + ..), s = (J - 1)/(J + 1), keeps its digits.
        j = real(1.0) + j1
        value = real(0.0)
        slope = real(0.0)
        if j < least:
            d = (j - least) / least
            value = j1 - log_least - d + real(0.5) * d * d
            slope = real(1.0) - (real(1.0) - d) / least
        else:
            slope = j1 / j
            if wp.abs(j1) < real(0.25):
                s = j1 / (real(2.0) + j1)
                z = s * s
                tail = real(1.0 / 15.0)
                for n in range(1, 7):
                    tail = real(1.0) / real(15 - 2 * n) + z * tail
                value = s * (j1 - real(2.0) * z * tail)
            else:
                value = j1 - wp.log(j)
        return value, slope

    @wp.func(module=module)
    def twist(g: real, j: real, mu: real, si: real, sj: real, sk: real):
        # tau / J^2 for the twist of the plane of s_i and s_j, from squared singular values
        return wp.max(g * g - mu * mu / sk, real(0.0)) / (real(0.5) * mu * (si + sj) + g * j)

    @wp.func(module=module)
    def least_additions(s: vec3, j: real, mu: real, kappa: real, g: real):
        # For c = -g < 0 and J > 0, with the squared singular values s: the least kappa, and tau / J^2, with which no
        # eigenvalue is negative. Twists: the determinant of each 2 x 2 block. Changes of stretch, in terms of A:
        # diag(mu s_k^2 + g J) + (kappa J^2 - g J) 1 1^T.
        tau = wp.max(twist(g, j, mu, s[1], s[2], s[0]),
                     wp.max(twist(g, j, mu, s[2], s[0], s[1]), twist(g, j, mu, s[0], s[1], s[2])))
        gj = g * j
        soft = real(1.0) / (mu * s[0] + gj) + real(1.0) / (mu * s[1] + gj) + real(1.0) / (mu * s[2] + gj)
        return wp.max(kappa, (gj - real(1.0) / soft) / (j * j)), tau

    @wp.func(module=module)
    def bulk(j: real, mu: real, lam: real):
        bent = wp.max(j, least)
        return lam + mu / (bent * bent)

    @wp.func(module=module)
    def projection(squares: vec3, j: real, mu: real, kappa: real, c: real):
        if c < real(0.0) and j > flat:
            more, tau = least_additions(squares, j, mu, kappa, -c)
            return c, more, tau
        # twists and flips are mu +- c s_k, and the stretches' part of c is 2 c s_0 at most
        size = real(2.0) * wp.abs(c) * wp.sqrt(squares[0])
        return c * mu / wp.max(size, mu), kappa, real(0.0)

    @wp.func(module=module)
    def respond(d: mat33, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int, push: real):
        # The energy is computed from the displacement gradient, not from F, so that it keeps its digits at small
        # strains: mu/2 (|F|^2 - 3) - mu (J - 1) = mu (|D|^2/2 - second - det D).
        f = deform(d)
        cof = cofactor(f)
        trace, rest = volume_change(d)
        j1 = trace + rest
        mu = own[t, q, 0]
        lam = own[t, q, 1]
        value, slope = barrier(j1)
        energy = mu * (real(0.5) * wp.ddot(d, d) - rest + value) + real(0.5) * lam * j1 * j1
        # P = mu F + c cof F = mu (F - cof F) + (c + mu) cof F
        return energy, real(1.0) + j1, mu * (f - cof) + (lam * j1 + mu * slope + push) * cof

    @wp.func(module=module)
    def linearise(d: mat33, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int, b: int,
                  push: real, projected: int, state_out: wp.array3d(dtype=real)):
        trace, rest = volume_change(d)
        mu = own[t, q, 0]
        lam = own[t, q, 1]
        _, slope = barrier(trace + rest)
        c = lam * (trace + rest) + mu * (slope - real(1.0)) + push
        kappa = bulk(real(1.0) + trace + rest, mu, lam)
        tau = real(0.0)
        if projected == 1:
            c, kappa, tau = projection(singular(deform(d)), real(1.0) + trace + rest, mu, kappa, c)
        state_out[t, 3 * q, b] = c
        state_out[t, 3 * q + 1, b] = kappa
        state_out[t, 3 * q + 2, b] = tau

    @wp.func(module=module)
    def multiply(d: mat33, x: mat33, own: wp.array3d(dtype=real), t: int, q: int, b: int,
                 state_in: wp.array3d(dtype=real)):
        f = deform(d)
        cof = cofactor(f)
        p = (own[t, q, 0] * x + (state_in[t, 3 * q + 1, b] * wp.ddot(cof, x)) * cof
             + state_in[t, 3 * q, b] * cofactor_change(f, x))
        tau = state_in[t, 3 * q + 2, b]
        if tau > real(0.0):
            turned = wp.transpose(cof) * x
            p += (real(0.5) * tau) * (cof * (turned - wp.transpose(turned)))
        return p

    return SimpleNamespace(respond=respond, linearise=linearise, multiply=multiply)


def parameters(mu: np.ndarray, lam: np.ndarray, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """mu and lambda of every point [Pa]."""
    return np.stack([mu, lam], axis=2), np.zeros((0, 1))


LAW = SolidLaw("neo-hooke", 3, functions, parameters, pressed=True)
