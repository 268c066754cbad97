"""The deformation gradient F in kernels: cofactor and its change, volume, singular values."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.runtime import mat33, real, vec3


def functions(module: str) -> Any:
    """Device functions, compiled into ``module``.

    ``gradient`` is F of a displacement gradient D, and ``cofactor`` cof F = J F^-T. ``cofactor_change`` is the
    derivative of cof F along a change of F. ``volume_change`` gives the two parts of J - 1 from D. ``squares`` gives
    the squared singular values of F, decreasing.
    """
    third_turn = wp.constant(real(2.0 * np.pi / 3.0))

    @wp.func(module=module)
    def gradient(d: mat33):
        return mat33(d[0, 0] + real(1.0), d[0, 1], d[0, 2], d[1, 0], d[1, 1] + real(1.0), d[1, 2], d[2, 0], d[2, 1],
                     d[2, 2] + real(1.0))

    @wp.func(module=module)
    def cofactor(f: mat33):
        return wp.matrix_from_rows(wp.cross(f[1], f[2]), wp.cross(f[2], f[0]), wp.cross(f[0], f[1]))

    @wp.func(module=module)
    def cofactor_change(f: mat33, d: mat33):
        return wp.matrix_from_rows(
            wp.cross(d[1], f[2]) + wp.cross(f[1], d[2]), wp.cross(d[2], f[0]) + wp.cross(f[2], d[0]),
            wp.cross(d[0], f[1]) + wp.cross(f[0], d[1]))

    @wp.func(module=module)
    def volume_change(d: mat33):
        # J - 1 = tr D + (second invariant of D) + det D, without cancellation: the trace, and the other two terms.
        second = (
            d[0, 0] * d[1, 1] + d[1, 1] * d[2, 2] + d[2, 2] * d[0, 0]
            - d[0, 1] * d[1, 0] - d[1, 2] * d[2, 1] - d[2, 0] * d[0, 2]
        )
        return d[0, 0] + d[1, 1] + d[2, 2], second + wp.dot(d[0], wp.cross(d[1], d[2]))

    @wp.func(module=module)
    def squares(f: mat33):
        # The roots of a cubic (Smith 1961).
        m = wp.transpose(f) * f
        centre = (m[0, 0] + m[1, 1] + m[2, 2]) / real(3.0)
        off = m[0, 1] * m[0, 1] + m[1, 2] * m[1, 2] + m[2, 0] * m[2, 0]
        a = m[0, 0] - centre
        b = m[1, 1] - centre
        e = m[2, 2] - centre
        p = wp.sqrt((a * a + b * b + e * e + real(2.0) * off) / real(6.0))
        out = vec3(centre, centre, centre)
        if p > real(1e-12) * centre:
            det = (a * (b * e - m[1, 2] * m[1, 2]) - m[0, 1] * (m[0, 1] * e - m[1, 2] * m[2, 0])
                   + m[2, 0] * (m[0, 1] * m[1, 2] - b * m[2, 0]))
            turn = wp.acos(wp.clamp(real(0.5) * det / (p * p * p), real(-1.0), real(1.0))) / real(3.0)
            top = centre + real(2.0) * p * wp.cos(turn)
            low = wp.max(centre + real(2.0) * p * wp.cos(turn + third_turn), real(0.0))
            out = vec3(top, wp.max(real(3.0) * centre - top - low, real(0.0)), low)
        return out

    return SimpleNamespace(gradient=gradient, cofactor=cofactor, cofactor_change=cofactor_change,
                           volume_change=volume_change, squares=squares)
