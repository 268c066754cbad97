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

COMMAND = "vsfsim measure stability"
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
