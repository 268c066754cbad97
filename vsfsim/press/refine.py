"""The same press on finer and finer meshes: observed order of convergence, extrapolated value, and its error.

Order and error as Celik et al. 2008 (Procedure for estimation and reporting of uncertainty due to discretization, J.
Fluids Eng. 130, 078001; after Roache 1994), for the last three meshes, finest first, with h the edge near the contact,
or (volume / tetrahedra)^(1/3) for a scan, whose triangles are of all sizes:

    p = |ln |e32 / e21| + q(p)| / ln r21,    q(p) = ln((r21^p - s) / (r32^p - s)),    s = sign(e32 / e21)
    e21 = F2 - F1,    F = F1 + (F1 - F2) / (r21^p - 1),    error = 1.25 |F1 - F2| / (r21^p - 1)

A sequence that is not monotone, or whose steps grow, has no order: then there is no extrapolation, and the error is the
spread.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.generate.press_result import MeshSeries, plain
from vsfsim.press.text import table as table_of

SAFETY = 1.25  # safety factor of the error for three meshes or more (Roache 1994) [-]
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

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return plain(vars(self))


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
    if not np.isfinite(f[-3:]).all():
        return Convergence(h, f, None, None, float("nan"),
                           f"No order of convergence is observed: at full depth a frame did not converge, so there is "
                           f"no {name} on every mesh.")
    e21, e32 = f[-2] - f[-1], f[-3] - f[-2]
    spread = float(np.ptp(f[-3:]))
    size = max(abs(float(f[-1])), 1e-300)
    noise = 2.0 * tolerance * size
    share = f"{100 * spread / size:.2g} %"
    if spread == 0.0 or spread <= noise:
        error = max(spread, tolerance * size)
        return Convergence(h, f, None, None, error,
                           f"The last three meshes agree to {share}, the solver's own tolerance: no order can be "
                           f"observed; the {name} is {f[-1]:.5g} {unit}, error about {error:.1g} {unit} "
                           f"({100 * error / size:.2g} %).")
    r21, r32 = h[-2] / h[-1], h[-3] / h[-2]
    # Smallest ratio of two steps that a positive order can give; 1 for equal ratios of the edges.
    if e21 * e32 <= 0.0 or e32 / e21 <= np.log(r32) / np.log(r21):
        why = "goes up and down" if e21 * e32 < 0.0 else "does not change less and less from mesh to mesh"
        return Convergence(h, f, None, None, spread,
                           f"No order of convergence is observed: the {name} {why}. It is {f[-1]:.5g} {unit} on the "
                           f"finest mesh, and the spread of the last three, {spread:.2g} {unit} ({share}), stands for "
                           f"its error. More meshes, or a finer first mesh, may show one.")
    order = _order(r21, r32, float(e32 / e21))
    used = min(order, STEEP)
    gain = r21**used - 1.0
    value = float(f[-1] - e21 / gain)
    error = SAFETY * abs(float(e21)) / gain
    words = (f"Observed order of convergence {order:.2f}; extrapolated {name} {value:.5g} {unit}, error {error:.2g} "
             f"{unit} ({100 * error / max(abs(value), 1e-300):.2g} %); the finest mesh is off by "
             f"{100 * abs(f[-1] / value - 1.0):.2g} %.")
    if order > STEEP:
        words += f" More than {STEEP:g} is chance with quadratic elements: {STEEP:g} was used."
    if order < 0.5:
        words += " So low an order extrapolates far: take a finer first mesh before trusting it."
    return Convergence(h, f, float(order), value, error, words)


def _order(r21: float, r32: float, ratio: float) -> float:
    """Solve p ln r21 = ln(ratio) + ln((r21^p - 1) / (r32^p - 1)) for p > 0; ratio > 1, the sequence is monotone.

    (r32^p - 1) r21^p / (r21^p - 1) grows with p from ln r32 / ln r21, which is under the ratio.
    """
    def steps(p: float) -> float:
        return (r32**p - 1.0) * r21**p / (r21**p - 1.0)

    low, high = 1e-6, 60.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if steps(middle) < ratio else (low, middle)
    return 0.5 * (low + high)


def extrapolate(series: MeshSeries, source: str) -> dict[str, Convergence]:
    """Order, extrapolation and error of every quantity of a series, by its name.

    Raises:
        SceneError: two meshes came out of the same size; ``source`` is the scene file.
    """
    if -np.diff(series.edge).max() < 0.02 * max(series.edge):
        raise SceneError(f"{source}: two of the {len(series.edge)} meshes came out of the same size ({series.sizes}), "
                         f"so there is no convergence to see; {series.advice}.")
    return {name: convergence(series.edge, values, tolerance=series.tolerance, name=name, unit=unit)
            for name, (unit, values) in series.quantities.items()}


def text(series: MeshSeries, found: Mapping[str, Convergence]) -> list[str]:
    """The meshes as a table, and what they say."""
    converged = np.array([bool(r.converged.all()) for r in series.results])
    marked = np.array([row["converged"] for row in series.rows]) if len(series.rows) > len(converged) else converged
    rows = [series.title, table_of(series.columns, marked), *(f"At full depth: {c.statement}" for c in found.values())]
    if not converged.all():
        rows.append("Some frames did not converge: their forces are no equilibria, and the order means nothing until "
                    "they do.")
    return rows


def table(series: MeshSeries, found: Mapping[str, Convergence]) -> dict[str, Any]:
    """For JSON: the meshes and the convergence of each quantity, that of the force alone on the same level."""
    tables = {name.replace(" ", "_"): c.table() for name, c in found.items()}
    return {**(tables["normal_force"] if len(tables) == 1 else tables), "meshes": series.rows}
