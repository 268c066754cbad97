"""The same press on finer and finer meshes: what they say of each quantity, see `vsfsim.physics.convergence`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.generate.press_result import MeshSeries, plain
from vsfsim.physics.convergence import Convergence, convergence
from vsfsim.press.text import table as table_of


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
    tables = {name.replace(" ", "_"): plain(vars(c)) for name, c in found.items()}
    return {**(tables["normal_force"] if len(tables) == 1 else tables), "meshes": series.rows}

