"""Finer and finer meshes: observed order of convergence of a quantity, its extrapolated value, and the error of that.

Order and error as Celik et al. 2008 (Procedure for estimation and reporting of uncertainty due to discretization, J.
Fluids Eng. 130, 078001; after Roache 1994), for the last three meshes, finest first, with h the edge near the contact,
or (volume / tetrahedra)^(1/3) for a scan, whose triangles are of all sizes:

    p = |ln |e32 / e21| + q(p)| / ln r21,    q(p) = ln((r21^p - s) / (r32^p - s)),    s = sign(e32 / e21)
    e21 = F2 - F1,    F = F1 + (F1 - F2) / (r21^p - 1),    error = 1.25 |F1 - F2| / (r21^p - 1)

A single quantity that goes up and down, or whose steps do not shrink, is not extrapolated, and its error is the spread.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

SAFETY = 1.25  # safety factor of the error for three meshes or more (Roache 1994) [-]
FLAT = 1.0  # order of a force, which is an energy over a way, where displacements go with the root of the distance from
#             a line, as at a crack, the strongest singularity of an elastic body; a lower observed order is chance [-]
STEEP = 4.0  # order of an integral of stresses with quadratic elements; a higher observed order is chance [-]


@dataclass(frozen=True)
class Convergence:
    """Convergence of one quantity, a force [N] or a pressure [Pa], over a sequence of meshes."""

    edge: np.ndarray
    """h of each mesh, coarsest first (k,) [m]."""
    force: np.ndarray
    """Value on each mesh (k,), in its unit."""
    order: float | None
    """Observed order of convergence [-]; None if there is none."""
    extrapolated: float | None
    """Extrapolated value [N or Pa]; None without an order."""
    error: float
    """Error of the extrapolated value, or of the finest mesh's without an order [N or Pa]."""
    statement: str
    """In words."""


def convergence(edge: Sequence[float], force: Sequence[float], *, tolerance: float, name: str = "force",
                unit: str = "N") -> Convergence:
    """Order, extrapolation and error of a quantity on three or more meshes.

    Args:
        edge: h of each mesh, coarsest first [m].
        force: value on each mesh.
        tolerance: relative error of each value left by the solver [-].
        name, unit: of the quantity, for the statement.
    """
    h, f = np.asarray(edge, float), np.asarray(force, float)
    assert len(h) == len(f) >= 3 and (np.diff(h) < 0.0).all()
    limit = curve_limit(edge, f[:, None], tolerance=tolerance, flat=0.0)
    order, value, error = limit.order, float(limit.value[0]), float(limit.error[0])
    if order is None or value == f[-1]:
        error = max(error, float(np.ptp(f[-3:])))
        return Convergence(h, f, None, None, error,
                           f"No order of convergence is observed: {limit.why}. The {name} is {f[-1]:.5g} {unit} on the "
                           f"finest mesh, error about {error:.2g} {unit} "
                           f"({100 * error / max(abs(float(f[-1])), 1e-300):.2g} %).")
    words = (f"Observed order of convergence {order:.2f}; extrapolated {name} {value:.5g} {unit}, error {error:.2g} "
             f"{unit} ({100 * error / max(abs(value), 1e-300):.2g} %); the finest mesh is off by "
             f"{100 * abs(f[-1] / value - 1.0):.2g} %.")
    if order > STEEP:
        words += f" More than {STEEP:g} is chance with quadratic elements: {STEEP:g} was used."
    if order < 0.5:
        words += " So low an order extrapolates far: take a finer first mesh before trusting it."
    return Convergence(h, f, order, value, error, words)


def _order(r21: float, r32: float, ratio: float) -> float:
    """Solve p ln r21 = ln(ratio) + ln((r21^p - 1) / (r32^p - 1)) for p > 0; ratio > 1, the sequence is monotone.

    (r32^p - 1) r21^p / (r21^p - 1) grows with p from ln r32 / ln r21, which is under the ratio.
    """
    def over(p: float) -> float:
        return (r32**p - 1.0) * r21**p / (r21**p - 1.0) - ratio

    low, high = 1e-6, 60.0
    return low if over(low) >= 0.0 else high if over(high) <= 0.0 else float(brentq(over, low, high, xtol=1e-14))


@dataclass(frozen=True)
class Limit:
    """What a reading goes to over finer and finer meshes."""

    value: np.ndarray
    """In every frame (T, ...), in its unit."""
    error: np.ndarray
    """Of the value (T, ...), in its unit; not a number where the meshes do not tell it."""
    order: float | None
    """Observed order of convergence [-]; None where there is none, or where the meshes agree to the tolerance."""
    why: str
    """How the value was found, or why its error is not known, in words."""


def curve_limit(edge: Sequence[float], values: np.ndarray, *, tolerance: float, flat: float = FLAT) -> Limit:
    """The limit of a whole curve, from the last three meshes.

    One order is observed for the curve: the equation above with the root mean squares of both steps over all frames and
    components, because single frames scatter with the place of the contact on the elements; it is taken as at least
    ``flat`` and at most `STEEP`. Where the second step goes
    on in the direction of the first, the curve is extrapolated. Where it turns back, the finest mesh's curve is taken,
    and its error is at least the last step. Where the steps do not shrink there is no order: the finest mesh's curve is
    taken with `SAFETY` times the spread of the three as its error.

    Args:
        edge: h of each mesh, coarsest first (k,) [m].
        values: on each mesh (k, T, ...).
        tolerance: relative error of each value left by the solver [-].
        flat: the least order [-].
    """
    h, f = np.asarray(edge, float)[-3:], np.asarray(values, float)[-3:]
    assert len(h) == len(f) == 3
    size = max(float(np.abs(f[-1]).max(initial=0.0)), 1e-300)
    least = tolerance * size
    if not np.isfinite(f).all():
        return Limit(f[-1], np.full(f[-1].shape, np.nan), None, "a frame did not converge on every mesh")
    if h[0] / h[1] < 1.02 or h[1] / h[2] < 1.02:
        return Limit(f[-1], np.full(f[-1].shape, np.nan), None, "two meshes came out of the same size")
    last, first = f[1] - f[2], f[0] - f[1]
    e21, e32 = (float(np.sqrt(np.mean(step**2))) for step in (last, first))
    r21, r32 = h[1] / h[2], h[0] / h[1]
    if max(e21, e32) <= 2.0 * least:
        return Limit(f[-1], np.full(f[-1].shape, 2.0 * least), None, "the meshes agree to the solver's tolerance")
    if e21 == 0.0 or e32 / e21 <= np.log(r32) / np.log(r21):
        spread = float(np.sqrt(np.mean(np.ptp(f, axis=0) ** 2)))
        return Limit(f[-1], np.full(f[-1].shape, SAFETY * spread), None, f"the steps do not shrink from mesh to mesh, "
                     f"so there is no order, and {SAFETY:g} times their spread of {100 * spread / size:.2g} % is taken "
                     f"as the error")
    order = _order(r21, r32, e32 / e21)
    gain = r21 ** min(max(order, flat), STEEP) - 1.0
    value, error, why = f[-1] - last / gain, SAFETY * np.abs(last) / gain + least, "extrapolated"
    if float((last * first).sum()) < 0.0:
        value, error = f[-1], np.maximum(error, np.abs(last))
        why = "the readings go up and down from mesh to mesh, ever less"
    return Limit(value, error, order, why)


def frames_limit(edge: Sequence[float], values: np.ndarray, least: float, *, tolerance: float) -> Limit:
    """`curve_limit` of forces (k, T, ...) whose errors count by the force in the same frame, where that is above
    ``least`` [N]: each is taken over its size, so that the deepest frames do not decide what the shallow ones are off.
    Smaller ones are those of the finest mesh, and their errors the spread."""
    size = np.linalg.norm(values.reshape(*values.shape[:2], -1), axis=2).max(axis=0)
    on = size > least
    if not on.any() or not np.isfinite(values).all():
        return curve_limit(edge, values, tolerance=tolerance)
    size = size[on].reshape(-1, *[1] * (values.ndim - 2))
    found = curve_limit(edge, values[:, on] / size, tolerance=tolerance)
    value, error = values[-1].copy(), np.ptp(values, axis=0)
    value[on], error[on] = found.value * size, found.error * size
    return dataclasses.replace(found, value=value, error=error)
