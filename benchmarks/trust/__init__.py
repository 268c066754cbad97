"""The trust map: random presses, each against the same press on a finer mesh and path: `vsfsim measure trust`.

It asks what a user asks: is the force that I am shown right, and if it is not, am I told? `vsfsim stability` presses at
the extremes instead, and asks whether a frame that is called converged contradicts mechanics.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measurement import Column, Measurement, Progress, Table
from benchmarks.trust.compare import FINER, FRAMES, WRONG, judge
from vsfsim.core.errors import VsfsimError

WITHIN = (0.05, 0.10, 0.30)
"""Errors that the report tells apart [-]."""


def measure(cells: int, seed: int, file: Path | None, *, progress: Progress = lambda said: None) -> Measurement:
    """Press the first ``cells`` of a ``seed``; ``file`` keeps a line for each, from which a later run goes on.

    Raises:
        VsfsimError: the file is not of this seed, or no such file.
    """
    done = _kept(file, seed)
    for number in range(cells):
        if number in done:
            continue
        progress(f"cell {number + 1} of {cells} ...")
        done[number] = judge(seed, number).table()
        if file is not None:
            with file.open("a") as out:
                out.write(json.dumps({"seed": seed, **done[number]}) + "\n")
    return report([done[number] for number in range(cells)], {"cells": cells, "seed": seed})


def _kept(file: Path | None, seed: int) -> dict[int, dict[str, Any]]:
    if file is None or not file.exists():
        return {}
    try:
        rows = [json.loads(line) for line in file.read_text().splitlines()]
        if any(row["seed"] != seed for row in rows):
            raise VsfsimError(f"{file} has cells of another seed than {seed}; give another --out.")
        return {row["number"]: row for row in rows}
    except (ValueError, KeyError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `vsfsim measure trust` ({error}); give another --out.") from None


def report(rows: list[dict[str, Any]], settings: dict[str, Any]) -> Measurement:
    """Shares of the cells, by all and by kind, and every cell that is wrong in silence."""
    judged = [row for row in rows if row["outcome"] in ("sound", "wrong", "marked")]
    kinds = Counter(kind for row in judged for kind in row["kinds"][:7])
    shares = [_shares("all", judged)] + [_shares(kind, [row for row in judged if kind in row["kinds"]])
                                         for kind, _ in kinds.most_common()]
    columns = (Column("kind", "cells"), Column("number", "number", "1", form="d"),
               *(Column(f"within_{100 * w:.0f}", f"within {100 * w:.0f} %", "1", "%", ".0f") for w in WITHIN),
               Column("marked", "marked whole", "1", "%", ".0f"), Column("wrong", "wrong in silence", "1", "%", ".1f"))
    tables = [Table("Cells by the largest error of a frame that is not marked", columns, shares, "shares")]
    wrong = [row for row in judged if row["outcome"] == "wrong"]
    if wrong:
        tables.append(Table("Cells that are wrong in silence", (
            Column("number", "cell", "1", form="d"), Column("error", "error", "1", "%", ".0f"), Column("kind", "kind")),
            [{**row, "kind": ", ".join(row["kinds"])} for row in wrong], "wrong"))
    others = Counter(f"{row['outcome']}: {row['words'][:80]}" for row in rows if row not in judged)
    return Measurement.of("trust", settings, tables, numbers={"cells": rows, "without_reference": dict(others)}, notes=[
        f"the reference is tier fem on elements of {FINER:g} of the smaller of the press's own and that tier's, with "
        f"{FRAMES} frames at least on each part of the path",
        f"a frame is wrong in silence if its force is off by more than {100 * WRONG:g} % and it is neither marked nor "
        f"told as not resolved; {len(rows) - len(judged)} of {len(rows)} cells are not judged"])


def _shares(kind: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    error = np.array([np.inf if row["error"] is None else row["error"] for row in rows])
    return {"kind": kind, "number": len(rows), **{f"within_{100 * w:.0f}": float((error <= w).mean()) for w in WITHIN},
            "marked": float(np.isinf(error).mean()), "wrong": float(np.mean([r["outcome"] == "wrong" for r in rows]))}
