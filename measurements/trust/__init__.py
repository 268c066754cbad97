"""The trust map: random presses, each against the same press on a finer mesh and path: `vsfsim measure trust`.

It asks what a user asks: is the force that I am shown right, and if it is not, am I told? `vsfsim stability` presses at
the extremes instead, and asks whether a frame that is called converged contradicts mechanics.
"""

from __future__ import annotations

import json
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import vsfsim
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.stability.team import Ended, answers, kept
from measurements.trust.compare import FINER, FRAMES, LATE, WRONG, Verdict, judge
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.data.provenance import commit

COMMAND = "vsfsim measure trust"
LIMIT = 30.0
"""Processor time that a press, or its reference, may take [s]."""
WITHIN = (0.05, 0.10, 0.30)
"""Errors that the report tells apart [-]."""
JUDGED = ("sound", "wrong", "marked")
"""Outcomes of a cell whose press is known to be right, wrong or marked, see `Verdict`."""
_SLOW, _SPARE = 8.0, 300.0  # wall over processor time of a loaded machine; for kernels [s]


def measure(cells: int, seed: int, file: Path | None, *, limit: float = LIMIT, workers: int = 1,
            budget: float | None = None, progress: Progress = lambda said: None) -> Measurement:
    """Press the first ``cells`` of a ``seed``.

    Args:
        cells: how many.
        seed: of the cells.
        file: keeps a line for each, from which a later run goes on; None for none.
        limit: processor time of a press, and of its reference [s]; a cell that takes more is not judged. Those of a
            ``file`` that took more than a shorter limit are pressed again, after the others.
        workers: processes.
        budget: time after which no cell begins [s]; None for none.
        progress: called with a sentence a cell.

    Raises:
        VsfsimError: the file was made with another seed, version or commit, or is no such file.
    """
    settings = {"seed": seed, "version": vsfsim.__version__, "commit": commit()}
    done = {} if file is None else _rows(file, settings)
    late = [number for number, row in done.items() if row["words"].endswith(LATE) and row["limit"] < limit]
    jobs = [(seed, number) for number in (*(n for n in range(cells) if n not in done), *sorted(late))]
    if jobs:
        progress("kernels are compiled, if they are not there")
        _compile()
    for (_, number), found in answers(jobs, partial(judge, limit=limit), workers=workers,
                                      most=2.0 * _SLOW * limit + _SPARE, budget=budget):
        if isinstance(found, Ended):
            found = Verdict(number, "not judged" if found.late else "crashed", seconds=found.seconds,
                            words=f"the press {LATE}" if found.late else found.words)
        done[number] = {**found.table(), "limit": limit}
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps(done[number]) + "\n")
        progress(f"{len(done)} of {cells} cells")
    return _report([done[number] for number in sorted(done) if number < cells], cells, settings)


def stored(file: Path) -> Measurement:
    """The report of the cells in a ``file`` of `measure`.

    Raises:
        VsfsimError: it is no such file.
    """
    if not file.exists():
        raise VsfsimError(f"{file} does not exist. Run `{COMMAND} --out {file}`.")
    first = file.read_text().partition("\n")[0]
    rows = _rows(file, {})
    return _report([rows[number] for number in sorted(rows)], len(rows), from_json(first))


def _rows(file: Path, settings: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """The last line of each cell, by its number."""
    rows = kept(file, settings, COMMAND)
    if any(not {"number", "outcome", "kinds", "error", "words", "limit"} <= row.keys() for row in rows):
        raise VsfsimError(f"{file} is not a file of `{COMMAND}`. Give another --out.")
    return {row["number"]: row for row in rows}


def _report(rows: list[dict[str, Any]], cells: int, settings: dict[str, Any]) -> Measurement:
    limit = max((row["limit"] for row in rows), default=LIMIT)
    return report(rows, {"cells": cells, **settings, "limit": limit})


def _compile() -> None:
    """What presses launch, once for all processes."""
    from vsfsim.physics.runtime import compile_kernels
    from vsfsim.physics.solve.kernels import solver_kernels

    compile_kernels(solver_kernels([("tet10", law) for law in ("neo-hooke", "hyperfoam")]), "cpu")


def report(rows: list[dict[str, Any]], settings: dict[str, Any]) -> Measurement:
    """Shares of the cells, by all and by kind, every cell that is wrong in silence, and why others are not judged."""
    kinds = Counter(word for row in rows for word in _words(row))
    shares = [_shares("all", rows)] + [_shares(kind, [row for row in rows if kind in _words(row)])
                                       for kind, _ in kinds.most_common()]
    columns = (Column("kind", "cells"), Column("cells", "presses", "1", form="d"),
               Column("without", "no reference", "1", "%", ".0f"), Column("judged", "judged", "1", form="d"),
               *(Column(f"within_{100 * w:.0f}", f"within {100 * w:.0f} %", "1", "%", ".0f") for w in WITHIN),
               Column("marked", "all frames marked", "1", "%", ".0f"),
               Column("wrong", "wrong in silence", "1", "%", ".1f"))
    tables = [Table("Cells by the largest error of a frame that is not marked, shares of the judged ones", columns,
                    shares, "shares")]
    wrong = [row for row in rows if row["outcome"] == "wrong"]
    if wrong:
        tables.append(Table("Cells that are wrong in silence", (
            Column("number", "cell", "1", form="d"), Column("error", "error", "1", "%", ".0f"), Column("kind", "kind")),
            [{**row, "kind": ", ".join(row["kinds"])} for row in wrong], "wrong"))
    others = Counter(f"{row['outcome']}: {row['words'][:80]}" for row in rows if row["outcome"] not in JUDGED)
    if others:
        tables.append(Table("Cells that are not judged", (
            Column("why", "why"), Column("number", "cells", "1", form="d")),
            [{"why": why, "number": n} for why, n in others.most_common()], "others"))
    return Measurement.of("trust", settings, tables, numbers={"every_cell": rows}, notes=[
        f"the reference is tier fem on elements of {FINER:g} of the smaller of the press's own and that tier's, with "
        f"{FRAMES} frames at least on each part of the path",
        f"a frame is wrong in silence if its force is off by more than {100 * WRONG:g} % and it is neither marked nor "
        f"told as not resolved",
        *([f"{settings['cells'] - len(rows)} cells were not begun; run the same command again to go on"]
          if len(rows) < settings["cells"] else [])])


def _words(row: dict[str, Any]) -> set[str]:
    return {word for kind in row["kinds"][:7] for word in kind.split(", ")}


def _shares(kind: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    judged = [row for row in rows if row["outcome"] in JUDGED]
    error = np.array([np.inf if row["error"] is None else row["error"] for row in judged])
    wrong = np.array([row["outcome"] == "wrong" for row in judged], bool)

    def share(which: np.ndarray) -> float:
        return float(which.mean()) if len(which) else float("nan")

    return {"kind": kind, "cells": len(rows), "judged": len(judged),
            "without": 1.0 - len(judged) / len(rows) if rows else float("nan"),
            **{f"within_{100 * w:.0f}": share(error <= w) for w in WITHIN}, "marked": share(np.isinf(error)),
            "wrong": share(wrong)}
