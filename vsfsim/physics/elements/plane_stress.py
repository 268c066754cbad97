"""Laws of a membrane in plane stress: its energy W [J/m^2] as a function of the principal stretches l1 >= l2.

With M = E h, the modulus times the thickness [N/m], W is one of two laws:

    "neo-hookean":             mu h/2 (l1^2 + l2^2 + 1/(l1 l2)^2 - 3),                  mu h = M/3
    "saint-venant-kirchhoff":  M/(2 (1 - nu^2)) (e1^2 + e2^2 + 2 nu e1 e2),             e = (l^2 - 1)/2

The first is incompressible: the thickness follows the area. The second is the linear elasticity of small strains in
plane stress at any rotation. It serves closed forms and plates, and does not hold for stretches of tens of per cent.

A membrane too thin to carry compression wrinkles. Its *relaxed* energy (Pipkin 1986, "The relaxed energy density for
isotropic elastic membranes", IMA J. Appl. Math. 36) is W where both stresses are tensions, the energy of simple tension
where the narrow side would be squeezed,

    neo-Hookean  mu h/2 (l1^2 + 2/l1 - 3)  for  l2 < l1^-1/2;      St Venant-Kirchhoff  M/2 e1^2  for  e2 < -nu e1,

and 0 where both are slack. The relaxed energy is convex and never falls with l1 or l2, hence it is convex in the
positions, and its true tangent is positive semi-definite.
"""

from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.runtime import real

LAWS = ("neo-hookean", "saint-venant-kirchhoff")
"""Names of the laws; the kernels know a law by its index."""


def functions(module: str) -> Any:
    """Device functions, compiled into ``module``.

    regime: whether the sheet is taut, wrinkled or slack. law_of: W and its derivatives by l1 and l2.
    """
    # Within rounding of the rest state the sheet counts as taut.
    slack = wp.constant(real(-1e-9 if real is wp.float64 else -1e-5))
    zero, half, one, two, three = (wp.constant(real(v)) for v in (0.0, 0.5, 1.0, 2.0, 3.0))

    @wp.func(module=module)
    def regime(l1: real, l2: real, law: int, nu: real, relaxed: int):
        # 2: taut, or compression is carried; 1: wrinkled; 0: slack
        out = int(2)  # noqa: UP018, RUF046  a Warp variable, not a constant
        if relaxed == 1:
            narrow = l1 * l2 * l2 - one
            stretched = l1 - one
            if law == 1:
                narrow = half * (l2 * l2 - one) + nu * half * (l1 * l1 - one)
            if narrow < slack:
                out = 0
                if stretched > zero:
                    out = 1
        return out

    @wp.func(module=module)
    def law_of(l1: real, l2: real, m: real, law: int, nu: real, state: int):
        # W, g1, g2
        w = zero
        g1 = zero
        g2 = zero
        if law == 0:
            mu = m / three
            if state == 2:
                j = one / (l1 * l1 * l2 * l2)
                w = half * mu * (l1 * l1 + l2 * l2 + j - three)
                g1 = mu * (l1 - j / l1)
                g2 = mu * (l2 - j / l2)
            if state == 1:
                w = half * mu * (l1 * l1 + two / l1 - three)
                g1 = mu * (l1 - one / (l1 * l1))
        else:
            e1 = half * (l1 * l1 - one)
            e2 = half * (l2 * l2 - one)
            if state == 2:
                k = m / (one - nu * nu)
                w = half * k * (e1 * e1 + e2 * e2 + two * nu * e1 * e2)
                g1 = k * (e1 + nu * e2) * l1
                g2 = k * (e2 + nu * e1) * l2
            if state == 1:
                w = half * m * e1 * e1
                g1 = m * e1 * l1
        return w, g1, g2

    return SimpleNamespace(regime=regime, law_of=law_of)
