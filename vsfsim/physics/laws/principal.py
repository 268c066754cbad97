"""Laws in terms of principal stretches: their stress and tangent from an energy and its two derivatives.

With F = U diag(l) V^T (l3 < 0 in an inverted element) the tangent acts on X = U^T dF V (Smith, de Goes and Kim 2019):
the 3 x 3 block Psi_ab on its diagonal, (Psi_a - Psi_b)/(l_a - l_b) on the symmetric part of each pair (a, b) and (Psi_a
+ Psi_b)/(l_a + l_b) on the skew part. The projected tangent sets negative eigenvalues of each to zero. A tangent stores
`STORED` numbers: U, V and the block of the stretches (27), the symmetric and the skew parts of the pairs (0, 1), (1,
2), (2, 0).
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.runtime import mat33, real, vec3

STORED = 33
"""Numbers that a tangent stores at a point."""
_SWEEPS = 6  # of Jacobi's method; it converges quadratically, and four suffice for a 3 x 3 matrix in double precision


def exp_rest(module: str) -> Any:
    """A device function, compiled into ``module``: exp(y) - 1 - y, which keeps its digits near 0."""
    @wp.func(module=module)
    def exp_rest(y: real):
        if wp.abs(y) > real(0.5):
            return wp.exp(y) - real(1.0) - y
        tail = real(1.0)
        for n in range(13):
            tail = real(1.0) + tail * y * (real(1.0) / real(15 - n))  # the compiler divides, once
        return real(0.5) * y * y * tail

    return exp_rest


def decomposition(module: str) -> Any:
    """Device functions, compiled into ``module``.

    ``eigen`` gives the eigenvalues (decreasing) and eigenvectors (columns, a rotation) of a symmetric matrix by
    Jacobi's method; with Warp's `eig3` forces take 1.6 times as long, and tangents 2.8 times. ``decompose`` gives x =
    ln of the singular values from the displacement gradient D, the signed singular values l (decreasing, the last one
    negative in an inverted element), and the rotations U and V with F = 1 + D = U diag(l) V^T. At small strains x keeps
    its digits, because it comes from F^T F - 1.
    """
    done = wp.constant(real(1e-17))

    @wp.func(module=module)
    def rotate(a: mat33, v: mat33, p: int, q: int, r: int):
        # one rotation in the plane of p and q that makes a_pq zero
        off = a[p, q]
        if wp.abs(off) > real(1e-300):
            theta = (a[q, q] - a[p, p]) / (real(2.0) * off)
            t = real(1.0) / (wp.abs(theta) + wp.sqrt(theta * theta + real(1.0)))
            if theta < real(0.0):
                t = -t
            c = real(1.0) / wp.sqrt(t * t + real(1.0))
            s = t * c
            a[p, p] = a[p, p] - t * off
            a[q, q] = a[q, q] + t * off
            a[p, q] = real(0.0)
            a[q, p] = real(0.0)
            rp = a[r, p]
            rq = a[r, q]
            a[r, p] = c * rp - s * rq
            a[p, r] = a[r, p]
            a[r, q] = s * rp + c * rq
            a[q, r] = a[r, q]
            for k in range(3):
                vp = v[k, p]
                vq = v[k, q]
                v[k, p] = c * vp - s * vq
                v[k, q] = s * vp + c * vq
        return a, v

    @wp.func(module=module)
    def ordered(e: vec3, v: mat33, p: int, q: int):
        # exchange the pairs p and q, one vector turned round, unless they are in order
        if e[p] < e[q]:
            x = e[p]
            e[p] = e[q]
            e[q] = x
            for k in range(3):
                y = v[k, p]
                v[k, p] = v[k, q]
                v[k, q] = -y
        return e, v

    @wp.func(module=module)
    def eigen(m: mat33):
        a = mat33(m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])
        v = mat33(real(1.0), real(0.0), real(0.0), real(0.0), real(1.0), real(0.0), real(0.0), real(0.0), real(1.0))
        sweeps = int(_SWEEPS)  # a variable: unrolled, the sweeps take Warp seconds to compile
        for _sweep in range(sweeps):
            # what is left changes neither eigenvalues nor vectors in double precision
            if wp.abs(a[0, 1]) + wp.abs(a[1, 2]) + wp.abs(a[2, 0]) <= done * (wp.abs(a[0, 0]) + wp.abs(a[1, 1])
                                                                              + wp.abs(a[2, 2])):
                break
            a, v = rotate(a, v, 0, 1, 2)
            a, v = rotate(a, v, 1, 2, 0)
            a, v = rotate(a, v, 2, 0, 1)
        e = vec3(a[0, 0], a[1, 1], a[2, 2])
        e, v = ordered(e, v, 0, 1)
        e, v = ordered(e, v, 1, 2)
        e, v = ordered(e, v, 0, 1)
        return e, v

    @wp.func(module=module)
    def log1p(e: real):
        # ln(1 + e) = 2 (s + s^3/3 + ..), s = e/(2 + e), where e is small
        if wp.abs(e) > real(0.25):
            return wp.log(wp.max(real(1.0) + e, real(1e-30)))
        s = e / (real(2.0) + e)
        z = s * s
        tail = real(1.0 / 15.0)
        for n in range(1, 8):
            tail = real(1.0) / real(15 - 2 * n) + z * tail
        return real(2.0) * s * tail

    @wp.func(module=module)
    def column(m: mat33, k: int):
        return vec3(m[0, k], m[1, k], m[2, k])

    @wp.func(module=module)
    def decompose(d: mat33):
        dt = wp.transpose(d)
        e, v = eigen(d + dt + dt * d)
        x = vec3(real(0.5) * log1p(e[0]), real(0.5) * log1p(e[1]), real(0.5) * log1p(e[2]))
        f0 = column(v, 0) + d * column(v, 0)
        f1 = column(v, 1) + d * column(v, 1)
        f2 = column(v, 2) + d * column(v, 2)
        u0 = wp.normalize(f0)
        u1 = f1 - wp.dot(f1, u0) * u0
        if wp.length(u1) > real(1e-12) * wp.length(f0):
            u1 = wp.normalize(u1)
        else:  # F maps everything to a line: any direction across it
            axis = vec3(real(1.0), real(0.0), real(0.0))
            if wp.abs(u0[0]) > real(0.7):
                axis = vec3(real(0.0), real(1.0), real(0.0))
            u1 = wp.normalize(wp.cross(u0, axis))
        u2 = wp.cross(u0, u1)
        return x, vec3(wp.dot(f0, u0), wp.dot(f1, u1), wp.dot(f2, u2)), wp.matrix_from_cols(u0, u1, u2), v

    return SimpleNamespace(eigen=eigen, decompose=decompose)


def functions_of(energy: Any, slopes: Any, curvatures: Any, module: str) -> Any:
    """The functions of a law, see `law.SolidLaw`, from three Warp functions of the stretches l, and of x = ln l where
    l > 0.

    Args:
        energy: (x, l, own, terms, t, q) -> Psi [J/m^3].
        slopes: (x, l, own, terms, t, q) -> dPsi/dl (3) [Pa].
        curvatures: (l, own, terms, t, q) -> d2Psi/dl dl (3 x 3) [Pa].
        module: see `law.SolidLaw`.
    """
    parts = decomposition(module)
    eigen, decompose = parts.eigen, parts.decompose
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
        x, lam, u, v = decompose(d)
        w = slopes(x, lam, own, terms, t, q)
        return energy(x, lam, own, terms, t, q), lam[0] * lam[1] * lam[2], u * wp.diag(w) * wp.transpose(v)

    @wp.func(module=module, inline=False)
    def linearise(d: mat33, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int, b: int,
                  push: real, projected: int, state_out: wp.array3d(dtype=real)):
        x, lam, u, v = decompose(d)
        w = slopes(x, lam, own, terms, t, q)
        h = curvatures(lam, own, terms, t, q)
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
