"""Soft tissue that stiffens exponentially: Fung's law, isotropic and compressible.

    Psi = mu/(2 b) [exp(b Q) - 1] + lambda/2 (J - 1)^2,     Q = sum_i (l_i^2 - 1 - 2 ln l_i) = I_1 - 3 - 2 ln J

with the principal stretches l (Demiray 1972, "A note on the elasticity of soft biological tissues", after Fung 1967; Q
in place of I_1 - 3, because it is of second order in the strain, so that small strains give mu and lambda). b = 0 would
be neo-Hookean. Q is continued by its Taylor polynomial of second order below l = `THIN`, and the exponential above b Q
= `STEEP`, so that inverted elements have a finite energy.
"""

from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.errors import SceneError
from vsfsim.physics.laws import principal
from vsfsim.physics.laws.law import Settings, SolidLaw
from vsfsim.physics.runtime import real, vec3

THIN, STEEP = 0.1, 12.0
"""Principal stretch, and exponent, beyond which their functions are continued by polynomials [-]."""


def parameters(mu: np.ndarray, lam: np.ndarray, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """mu and lambda of every point [Pa], and b [-].

    Raises:
        SceneError: b is not one number of 0.01 to 100.
    """
    b = np.atleast_1d(np.asarray(settings["b"], float))
    if b.shape != (1,) or not 0.01 <= b[0] <= 100.0:
        raise SceneError(f"law 'fung': b is {b.tolist()}; give one number of 0.01 to 100, e.g. b = 5.")
    return np.stack([mu, lam], axis=2), b[None]


def functions(module: str) -> Any:
    """See `law.SolidLaw`."""
    exp_rest, thin, steep = principal.exp_rest(module), wp.constant(real(THIN)), wp.constant(real(STEEP))

    @wp.func(module=module)
    def strain(lam: real):
        # slope and curvature of l^2 - 1 - 2 ln l
        a = wp.max(lam, thin)
        c = real(2.0) + real(2.0) / (a * a)
        return real(2.0) * (a - real(1.0)) * (a + real(1.0)) / a + c * (lam - a), c

    @wp.func(module=module)
    def exponent(x: vec3, lam: vec3, b: real):
        # b Q
        out = real(0.0)
        for k in range(3):
            if lam[k] >= thin:
                out += exp_rest(real(2.0) * x[k])
            else:
                d = lam[k] - thin
                s, c = strain(thin)
                out += thin * thin - real(1.0) - real(2.0) * wp.log(thin) + s * d + real(0.5) * c * d * d
        return b * out

    @wp.func(module=module)
    def growth(w: real):
        # exp(w) - 1, its slope and curvature
        v = wp.exp(wp.min(w, steep))
        d = wp.max(w - steep, real(0.0))
        value = exp_rest(w) + w
        if d > real(0.0):
            value = v * (real(1.0) + d + real(0.5) * d * d) - real(1.0)
        return value, v * (real(1.0) + d), v

    @wp.func(module=module)
    def swelling(x: vec3, lam: vec3):
        # J - 1
        y = x[0] + x[1] + x[2]
        if lam[2] > real(0.0):
            return exp_rest(y) + y
        return lam[0] * lam[1] * lam[2] - real(1.0)

    @wp.func(module=module)
    def energy(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        value, _, _ = growth(exponent(x, lam, terms[0, 0]))
        j1 = swelling(x, lam)
        return real(0.5) * (own[t, q, 0] / terms[0, 0] * value + own[t, q, 1] * j1 * j1)

    @wp.func(module=module)
    def slopes(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        _, g, _ = growth(exponent(x, lam, terms[0, 0]))
        pull = own[t, q, 1] * swelling(x, lam)
        out = vec3()
        for k in range(3):
            s, _ = strain(lam[k])
            if lam[k] >= thin:  # keeps its digits at small strains
                s = real(2.0) * (exp_rest(real(2.0) * x[k]) + real(2.0) * x[k]) / lam[k]
            out[k] = real(0.5) * own[t, q, 0] * g * s + pull * lam[(k + 1) % 3] * lam[(k + 2) % 3]
        return out

    @wp.func(module=module)
    def curvatures(lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        x = vec3(wp.log(wp.max(lam[0], thin)), wp.log(wp.max(lam[1], thin)), wp.log(wp.max(lam[2], thin)))
        _, g, h = growth(exponent(x, lam, terms[0, 0]))
        half, lame = real(0.5) * own[t, q, 0], own[t, q, 1]
        p = vec3(lam[1] * lam[2], lam[2] * lam[0], lam[0] * lam[1])
        out = lame * wp.outer(p, p)
        for a in range(3):
            sa, ca = strain(lam[a])
            out[a, a] = out[a, a] + half * g * ca
            for c in range(3):
                sc, _ = strain(lam[c])
                out[a, c] = out[a, c] + half * h * terms[0, 0] * sa * sc
                if a != c:
                    out[a, c] = out[a, c] + lame * (p[0] * lam[0] - real(1.0)) * lam[3 - a - c]
        return out

    return principal.functions_of(energy, slopes, curvatures, module)


LAW = SolidLaw("fung", principal.STORED, functions, parameters, settings=("b",))
