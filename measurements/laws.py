"""How far the laws of elasticity differ in compression: `vsfsim measure laws`.

Nominal stress of uniaxial compression with free sides, from the closed forms, all with the same Young's modulus and
Poisson's ratio at rest. No solver takes part, so the table says what a choice of the law is worth, and not how well it
is solved (`tests/physics/test_tet10.py`, `tests/verification/test_foams.py`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from measurements.measurement import Column, Measurement, Progress, Table

STRAINS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
RATIOS = (0.0, 0.1, 0.3, 0.45)

Law = Callable[[float, float, float, float], tuple[float, float]]
"""From the stretches (along, across) and (mu, lambda) with E = 1: nominal stress along and across."""


def _volumetric(slope: Callable[[float, float, float], float]) -> Law:
    """mu/2 (|F|^2 - 3) + U(J), from U'(J, mu, lambda)."""
    def law(axial: float, side: float, mu: float, lam: float) -> tuple[float, float]:
        push = slope(axial * side**2, mu, lam)
        return mu * axial + push * side**2, mu * side + push * axial * side

    return law


def _saint_venant(axial: float, side: float, mu: float, lam: float) -> tuple[float, float]:
    e, s = 0.5 * (axial**2 - 1.0), 0.5 * (side**2 - 1.0)
    trace = e + 2.0 * s
    return axial * (lam * trace + 2.0 * mu * e), side * (lam * trace + 2.0 * mu * s)


def _linear(axial: float, side: float, mu: float, lam: float) -> tuple[float, float]:
    trace = axial + 2.0 * side - 3.0
    return lam * trace + 2.0 * mu * (axial - 1.0), lam * trace + 2.0 * mu * (side - 1.0)


def _hyperfoam(alpha: float) -> Law:
    def law(axial: float, side: float, mu: float, lam: float) -> tuple[float, float]:
        push = (axial * side**2) ** (-alpha * lam / (2.0 * mu))
        return 2.0 * mu / alpha * (axial**alpha - push) / axial, 2.0 * mu / alpha * (side**alpha - push) / side

    return law


LAWS: dict[str, Law] = {
    "vsfsim": _volumetric(lambda j, mu, lam: lam * (j - 1.0) - mu / j),
    "neo-Hookean, (ln J)^2": _volumetric(lambda j, mu, lam: (lam * np.log(j) - mu) / j),
    "stable neo-Hookean": _volumetric(lambda j, mu, lam: (lam + mu) * (j - 1.0) - mu),
    "St Venant-Kirchhoff": _saint_venant,
    "small strain": _linear,
    "hyperfoam, alpha 4": _hyperfoam(4.0),
    "hyperfoam, alpha 8": _hyperfoam(8.0)}
"""Laws by name; the first is that of the finite-element tiers, the others are given against it."""


def pressure(law: Law, strain: float, nu: float) -> float:
    """Nominal pressure over E of uniaxial stress [-], on the branch that begins at rest; NaN past its end."""
    mu, lam = 0.5 / (1.0 + nu), nu / ((1.0 + nu) * (1.0 - 2.0 * nu))
    side, axial = 1.0, 1.0
    for axial in 1.0 - np.linspace(0.0, strain, 41)[1:]:
        def across(a: float, axial: float = axial) -> float:
            return law(axial, a, mu, lam)[1]

        low, high = max(side - 0.02, 1e-6), side + 0.05
        if across(low) * across(high) > 0.0:
            return float("nan")
        side = brentq(across, low, high, xtol=1e-14)
    return -law(axial, side, mu, lam)[0]


def measure(*, progress: Progress = lambda _: None) -> Measurement:
    """Stress of `vsfsim`'s law over E times the strain, and the other laws' differences from it."""
    names = list(LAWS)
    rows = []
    for nu in RATIOS:
        progress(f"nu = {nu:g}")
        for strain in STRAINS:
            own = pressure(LAWS[names[0]], strain, nu)
            rows.append({"nu": nu, "strain": strain, "own": own / strain,
                         **{name: pressure(LAWS[name], strain, nu) / own - 1.0 for name in names[1:]}})
    columns = (Column("nu", "nu", "1", form="g"), Column("strain", "compression", "1", "%", ".0f"),
               Column("own", "stress / (E strain)", "1", form=".3f"),
               *(Column(name, name, "1", "%", "+.1f") for name in names[1:]))
    return Measurement.of("laws", {}, [
        Table("nominal stress of uniaxial compression by the closed forms: the finite-element tiers' law, and what "
              "other laws of the same E and nu differ from it", columns, rows, name="laws")])
