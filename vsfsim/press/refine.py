"""The same press on finer and finer meshes: what they say of each quantity, see `vsfsim.physics.convergence`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.generate.press_result import Column, PressResult, plain
from vsfsim.physics.convergence import Convergence, convergence
from vsfsim.press.text import table as table_of


def extrapolate(results: Sequence[PressResult], source: str) -> dict[str, Convergence]:
    """Order, extrapolation and error of the normal force at full depth, and of a bubble's pressure, by name.

    Raises:
        SceneError: two meshes came out of the same size; ``source`` is the scene file.
    """
    edge = [r.edge for r in results]
    if -np.diff(edge).max() < 0.02 * max(edge):
        raise SceneError(f"{source}: two of the {len(edge)} meshes came out of the same size "
                         f"({', '.join(str(r.more['nodes']) for r in results)} nodes), so there is no convergence to "
                         f"see; give a finer resolution in [object], or a smaller contact_edge in [sensor].")
    wanted = {"normal force": ("N", [float(r.normal_force[r.deepest]) for r in results])}
    if "pressure_change" in results[0].more:
        wanted["pressure change"] = ("Pa", [float(r.more["pressure_change"][r.deepest]) for r in results])
    return {name: convergence(edge, values, tolerance=results[0].more["tolerance"], name=name, unit=unit)
            for name, (unit, values) in wanted.items()}


def text(results: Sequence[PressResult], found: Mapping[str, Convergence]) -> list[str]:
    """The meshes as a table, and what they say."""
    columns = [Column("mesh", range(1, len(results) + 1), "d"),
               Column("nodes", [r.more["nodes"] for r in results], "d"),
               Column("edge mm", [1e3 * r.edge for r in results], ".2f")]
    for name, one in found.items():
        columns += [Column(f"{name} {'Pa' if 'pressure' in name else 'N'}", one.force, ".5g"),
                    Column("change %", ["", *(f"{100 * (b / a - 1.0):+.2f}" if a and np.isfinite(b / a) else "-"
                                              for a, b in pairwise(one.force))])]
    columns += [Column("converged", [f"{int(r.converged.sum())}/{len(r.converged)}" for r in results]),
                Column("balance", [r.audit["force_balance"].max() for r in results], ".1e"),
                Column("penetr. %", [100 * r.audit["penetration"].max() / r.more["edge"] for r in results], ".2g"),
                Column("seconds", [r.more["build_seconds"] + r.more["seconds"].sum() for r in results], ".1f")]
    whole = np.array([bool(r.converged.all()) for r in results])
    rows = [f"At full depth on {len(results)} meshes:", table_of(columns, whole),
            *(f"At full depth: {c.statement}" for c in found.values())]
    if not whole.all():
        rows.append("Some frames did not converge: their forces are no equilibria, and the order means nothing until "
                    "they do.")
    return rows


def table(results: Sequence[PressResult], found: Mapping[str, Convergence]) -> dict[str, Any]:
    """For JSON: the meshes and the convergence of each quantity, that of the force alone on the same level."""
    tables = {name.replace(" ", "_"): plain(vars(c)) for name, c in found.items()}
    return {**(tables["normal_force"] if len(tables) == 1 else tables), "meshes": [r.table() for r in results]}
