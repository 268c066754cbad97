"""The gate's cells with all mechanisms and without some, or against an earlier record: frames, forces and cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from measurements.gate.cells import CELLS, SMALL, GateCell, Run, press
from measurements.gate.mechanisms import MECHANISMS, without
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError, one_of
from vsfsim.core.plain_text import from_json

_LEAST = 0.05  # of the largest force: the differences of smaller forces are told relative to this part of it [-]


def difference(a: Run, b: Run) -> float | None:
    """Largest difference of the force in the frames that converged in both, over that force [-]."""
    one, two = np.array(a.force, float), np.array(b.force, float)
    if one.shape != two.shape:
        return None
    size = np.linalg.norm(one, axis=1)
    both = np.isfinite(size) & np.isfinite(two).all(axis=1)
    if not both.any() or not size[both].max():
        return None
    apart = np.linalg.norm(one - two, axis=1)[both]
    return float((apart / np.maximum(size[both], _LEAST * size[both].max())).max())


def earlier(path: Path) -> dict[str, Run]:
    """The runs of a record that `measure` wrote, by cell.

    Raises:
        VsfsimError: the file is no such record.
    """
    try:
        rows = from_json(path.read_text())["cells"]
        return {row["cell"]: Run(**row["run"]) for row in rows}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise VsfsimError(f"{path} is not a record of `vsfsim measure solver --cell all --json FILE` ({error}). "
                          "Make one first.") from None


def _pairs(cells: Sequence[GateCell], names: Sequence[str], before: dict[str, Run] | None,
           progress: Progress) -> Iterator[tuple[str, Run | None, Run]]:
    for cell in cells:
        progress(cell.name)
        known = press(cell) if before is None and names else (before or {}).get(cell.name)
        with without(names):
            yield cell.name, known, press(cell)


def measure(cells: Sequence[str] = ("all",), *, names: Sequence[str] = (), against: Path | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Press the cells, and press them again without some mechanisms.

    Args:
        cells: their names, "small" for the quick ones, or "all".
        names: mechanisms that are switched off together.
        against: a record of an earlier run that is compared instead of a run with all mechanisms.
        progress: called with what is going on.

    Raises:
        VsfsimError: a cell or mechanism has no such name, or the record is none.
    """
    for name in names:
        one_of(name, MECHANISMS, "--without")
    for name in cells:
        one_of(name, [*(c.name for c in CELLS), "small", "all"], "--cell")
    chosen = [c for c in CELLS if "all" in cells or c.name in cells or ("small" in cells and c.name in SMALL)]
    press(next(c for c in CELLS if c.name == "ball"))  # kernels are loaded
    rows: list[dict[str, Any]] = []
    for name, known, run in _pairs(chosen, names, None if against is None else earlier(against), progress):
        rows.append({"cell": name, "run": asdict(run), "asked": run.asked, "frames": run.frames, "newton": run.newton,
                     "cg": run.cg, "cpu": run.cpu, "reasons": ", ".join(dict.fromkeys(run.reasons)),
                     **({} if known is None else _compared(known, run))})
    columns = (Column("cell", "cell"), Column("asked", "frames", "1"), Column("before", "converged before", "1"),
               Column("frames", "converged", "1"), Column("difference", "force differs", "1", "%", ".3f"),
               Column("newton", "Newton", "1"), Column("newton_ratio", "ratio", "1", form=".2f"),
               Column("cg", "CG", "1"), Column("cg_ratio", "ratio", "1", form=".2f"),
               Column("cpu", "CPU", "s", form=".2f"), Column("cpu_ratio", "ratio", "1", form=".2f"),
               Column("reasons", "marked"))
    said = f"without {', '.join(names)}" if names else "with all mechanisms"
    said += "" if against is None else f", against {against.name}"
    return Measurement.of("solver", {"cells": [c.name for c in chosen], "without": list(names)}, [
        Table(f"gate cells {said}", columns, rows, name="cells"),
        Table("all of them", columns[1:-1], [_total(rows)], name="total")])


def _compared(known: Run, run: Run) -> dict[str, Any]:
    return {"before": known.frames, "difference": difference(known, run), "newton_before": known.newton,
            "cg_before": known.cg, "cpu_before": known.cpu, "newton_ratio": run.newton / max(known.newton, 1),
            "cg_ratio": run.cg / max(known.cg, 1), "cpu_ratio": run.cpu / known.cpu}


def _total(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {key: sum(row[key] for row in rows) for key in ("asked", "frames", "newton", "cg", "cpu")}
    known = [row for row in rows if "before" in row]
    if known:
        out["before"] = sum(row["before"] for row in known)
        out["difference"] = max((row["difference"] for row in known if row["difference"] is not None), default=None)
        for key in ("newton", "cg", "cpu"):
            out[f"{key}_ratio"] = sum(row[key] for row in known) / sum(row[f"{key}_before"] for row in known)
    return out
