"""Laws in terms of principal stretches: their stress and tangent from an energy and its two derivatives.

With F = U diag(l) V^T (l3 < 0 in an inverted element) the tangent acts on X = U^T dF V (Smith, de Goes and Kim 2019):
the 3 x 3 block Psi_ab on its diagonal, (Psi_a - Psi_b)/(l_a - l_b) on the symmetric part of each pair (a, b) and (Psi_a
+ Psi_b)/(l_a + l_b) on the skew part. The projected tangent sets negative eigenvalues of each to zero. A tangent stores
`STORED` numbers: U, V and the block of the stretches (27), the symmetric and the skew parts of the pairs (0, 1), (1,
2), (2, 0).
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.runtime import mat33, real, vec3

STORED = 33
"""Numbers that a tangent stores at a point."""


def functions_of(energy: Any, slopes: Any, curvatures: Any, module: str) -> Any:
    """The functions of a law, see `law.SolidLaw`, from three Warp functions of the stretches l, which decrease; the
    last one is negative in an inverted element.

    Args:
        energy: (l, own, terms, t, q) -> Psi [J/m^3].
        slopes: (l, own, terms, t, q) -> dPsi/dl (3) [Pa].
        curvatures: (l, own, terms, t, q) -> d2Psi/dl dl (3 x 3) [Pa].
        module: see `law.SolidLaw`.
    """
    one = wp.constant(mat33(*np.eye(3).ravel()))
    # difference of two stretches below which their difference quotient is the mean of the derivatives
    near = wp.constant(real(1e-5))

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

    # not inlined: an element calls them at each of its points, and compilers then take three times as long
    @wp.func(module=module, inline=False)
    def respond(d: mat33, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int, push: real):
        u, lam, v = wp.svd3(one + d)
        w = slopes(lam, own, terms, t, q)
        return energy(lam, own, terms, t, q), lam[0] * lam[1] * lam[2], u * wp.diag(w) * wp.transpose(v)

    @wp.func(module=module, inline=False)
    def linearise(d: mat33, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int, b: int,
                  push: real, projected: int, state_out: wp.array3d(dtype=real)):
        u, lam, v = wp.svd3(one + d)
        w = slopes(lam, own, terms, t, q)
        h = curvatures(lam, own, terms, t, q)
        even = vec3()
        odd = vec3()
        for a in range(3):
            e, o = pair(lam, w, h, a, (a + 1) % 3)
            even[a] = e
            odd[a] = o
        if projected == 1:
            axes, values = wp.eig3(h)
            h = axes * wp.diag(wp.max(values, vec3())) * wp.transpose(axes)
            even = wp.max(even, vec3())
            odd = wp.max(odd, vec3())
        at = STORED * q
        for a in range(3):
            for c in range(3):
                state_out[t, at + 3 * a + c, b] = u[a, c]
                state_out[t, at + 9 + 3 * a + c, b] = v[a, c]
                state_out[t, at + 18 + 3 * a + c, b] = h[a, c]
            state_out[t, at + 27 + a, b] = even[a]
            state_out[t, at + 30 + a, b] = odd[a]

    @wp.func(module=module)
    def multiply(d: mat33, x: mat33, own: wp.array3d(dtype=real), t: int, q: int, b: int,
                 state_in: wp.array3d(dtype=real)):
        at = STORED * q
        u = mat33()
        v = mat33()
        h = mat33()
        for a in range(3):
            for c in range(3):
                u[a, c] = state_in[t, at + 3 * a + c, b]
                v[a, c] = state_in[t, at + 9 + 3 * a + c, b]
                h[a, c] = state_in[t, at + 18 + 3 * a + c, b]
        z = wp.transpose(u) * x * v
        y = wp.diag(h * wp.get_diag(z))
        for a in range(3):
            c = (a + 1) % 3
            even = real(0.5) * state_in[t, at + 27 + a, b] * (z[a, c] + z[c, a])
            odd = real(0.5) * state_in[t, at + 30 + a, b] * (z[a, c] - z[c, a])
            y[a, c] = even + odd
            y[c, a] = even - odd
        return u * y * wp.transpose(v)

    return SimpleNamespace(respond=respond, linearise=linearise, multiply=multiply)
