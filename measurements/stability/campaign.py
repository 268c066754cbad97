"""Many cells in worker processes: interrupted at any time, continued later, and ended by a budget of time."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from measurements.stability.design import Cell
from measurements.stability.judge import LATE, Outcome, Verdict, judge
from measurements.stability.team import Ended, answers, kept
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.data.disk import write_atomic
from vsfsim.physics.solve.frames import Reason

COMMAND = "vsfsim stability"
FRAMES = 80  # more than any cell has
SPARE = 180.0  # for meshes, factors and kernels of a cell [s]


def finished(file: Path, circumstances: dict[str, Any]) -> list[Verdict]:
    """The verdicts that a file already holds; a new file gets its first line.

    Args:
        file: see `team.kept`.
        circumstances: what must be the same for verdicts to be comparable: limit, commit and version.

    Raises:
        VsfsimError: see `team.kept`.
    """
    rows = kept(file, circumstances, COMMAND)
    try:
        return [Verdict.of(row) for row in rows]
    except (ValueError, KeyError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `{COMMAND}` ({error}). Give another folder.") from None


def take_over(before: Path, file: Path, circumstances: dict[str, Any]) -> list[Verdict]:
    """Begin ``file`` with the verdicts of ``before``, whose limit was shorter, but for cells that ended at that limit.

    A frame that ends within a limit ends within a longer one, with the same result.

    Args:
        before: a file of `run`, which stays as it is.
        file: see `finished`; if it is there already it is left alone.
        circumstances: as for `finished`, with the longer limit.

    Returns:
        All verdicts of ``before``.

    Raises:
        VsfsimError: ``before`` is no such file, its limit is not shorter, or it was made under other circumstances.
    """
    if not before.exists():
        raise VsfsimError(f"{before} does not exist. Give the folder of an earlier `vsfsim stability`.")
    shorter = _first_line(before).get("limit")
    if not isinstance(shorter, float) or shorter >= circumstances["limit"]:
        raise VsfsimError(f"{before} was made with limit {shorter!r}, which is not below this run's "
                          f"{circumstances['limit']!r}. Give a longer --limit.")
    known = finished(before, {**circumstances, "limit": shorter})
    if not file.exists():
        kept = [v for v in known if v.outcome is not Outcome.LATE and Reason.TIME.text not in v.reasons]
        rows = (circumstances, *(v.table() for v in kept))
        write_atomic(file, "".join(json.dumps(row) + "\n" for row in rows).encode())
    return known


def updated(known: Sequence[Verdict], again: Sequence[Verdict]) -> tuple[list[Verdict], int]:
    """``known`` with the verdicts of ``again`` in their places, and how many cells are not in ``again``."""
    newer = {v.cell.key: v for v in again}
    return [newer.get(v.cell.key, v) for v in known], sum(v.cell.key not in newer for v in known)


def _first_line(file: Path) -> dict[str, Any]:
    try:
        return dict(from_json(file.read_text().split("\n", 1)[0]))
    except (ValueError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `vsfsim stability` ({error}). Give another folder.") from None


def run(cells: Sequence[Cell], file: Path, *, limit: float, workers: int, device: str = "cpu",
        budget: float | None = None, circumstances: dict[str, Any] | None = None,
        progress: Callable[[int, int, str], None] | None = None) -> list[Verdict]:
    """Judge cells, and append each verdict to ``file`` as soon as it is there.

    A process that ends by itself or works longer than all its frames may is ended, and its cell counts as crashed or as
    over the limit.

    Args:
        cells: in the order in which they are made.
        file: see `finished`.
        limit: limit of a frame's processor time [s].
        workers: processes.
        device: Warp device.
        budget: time after which no new cell begins [s]; None for none.
        circumstances: see `finished`; limit and device are added.
        progress: called with (done, in all, what).

    Returns:
        The verdicts of the cells that are done, in the order of ``cells``.

    Raises:
        VsfsimError: see `finished`.
    """
    done = {v.cell.key: v for v in finished(file, {"limit": limit, "device": device, **(circumstances or {})})}
    waiting = [c for c in cells if c.key not in done]
    with file.open("a") as out:
        for cell, found in answers(waiting, partial(_work, limit=limit, device=device), workers=workers,
                                   most=FRAMES * LATE * limit + SPARE, budget=budget):
            if isinstance(found, Ended):
                outcome = Outcome.LATE if found.late else Outcome.CRASHED
                found = Verdict(cell, outcome, (found.words,), seconds=found.seconds)
            out.write(json.dumps(found.table()) + "\n")
            out.flush()
            done[cell.key] = found
            if progress is not None:
                progress(sum(c.key in done for c in cells), len(cells), "cells")
    return [done[c.key] for c in cells if c.key in done]


def _work(cell: Cell, limit: float, device: str) -> Verdict:
    found = judge(cell, limit, device)
    if device != "cpu":
        import torch

        gc.collect()
        torch.cuda.empty_cache()  # for the other processes
    return found
