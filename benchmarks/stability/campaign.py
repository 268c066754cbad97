"""Many cells in worker processes: interrupted at any time, continued later, and ended by a budget of time."""

from __future__ import annotations

import gc
import json
import multiprocessing as mp
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from benchmarks.stability.design import Cell
from benchmarks.stability.judge import LATE, Outcome, Verdict, judge
from vsfsim.core.errors import VsfsimError
from vsfsim.data.disk import write_atomic
from vsfsim.physics.solve.frames import Reason

FRAMES = 80  # more than any cell has
SPARE = 180.0  # for meshes, factors and kernels of a cell [s]


def finished(file: Path, circumstances: dict[str, Any]) -> list[Verdict]:
    """The verdicts that a file already holds; a new file gets its first line.

    Args:
        file: JSON lines: first the circumstances, then one verdict a line. A last line that was cut off by an
            interruption is removed.
        circumstances: what must be the same for verdicts to be comparable: limit, commit and version.

    Raises:
        VsfsimError: the file cannot be read, or was made under other circumstances.
    """
    if not file.exists():
        file.write_text(json.dumps(circumstances) + "\n")
        return []
    lines = file.read_text().split("\n")
    try:
        found = json.loads(lines[0])
        rows = [Verdict.of(json.loads(line)) for line in lines[1:-1]]
    except (ValueError, KeyError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `vsfsim stability` ({error}). Give another folder.") from None
    for name, value in circumstances.items():
        if found.get(name) != value:
            raise VsfsimError(f"{file} was made with {name} {found.get(name)!r}, and this run has {value!r}; their "
                              f"cells cannot be put together. Give another folder, or delete the file.")
    if lines[-1]:
        file.write_text("\n".join(lines[:-1]) + "\n")
    return rows


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
        return dict(json.loads(file.read_text().split("\n", 1)[0]))
    except (ValueError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `vsfsim stability` ({error}). Give another folder.") from None


@dataclass
class _Worker:
    """A process that judges cells, and what it is doing."""

    process: mp.process.BaseProcess
    pipe: Connection
    cell: Cell | None = None
    since: float = 0.0


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
    waiting = [c for c in cells if c.key not in done][::-1]
    began, team = time.perf_counter(), [_start(limit, device) for _ in range(min(workers, len(waiting)))]
    try:
        with file.open("a") as out:
            while True:
                over = budget is not None and time.perf_counter() - began > budget
                for worker in team:
                    if worker.cell is None and waiting and not over:
                        worker.cell, worker.since = waiting.pop(), time.perf_counter()
                        worker.pipe.send(worker.cell)
                busy = [w for w in team if w.cell is not None]
                if not busy:
                    break
                ready = wait([w.pipe for w in busy], timeout=1.0)
                for k, worker in enumerate(team):
                    verdict = _verdict(worker, ready, limit)
                    if verdict is None:
                        continue
                    out.write(json.dumps(verdict.table()) + "\n")
                    out.flush()
                    done[verdict.cell.key] = verdict
                    if worker.process.is_alive():
                        worker.cell = None
                    else:
                        team[k] = _start(limit, device)
                    if progress is not None:
                        progress(sum(c.key in done for c in cells), len(cells), "cells")
    finally:
        for worker in team:
            worker.process.kill()
    return [done[c.key] for c in cells if c.key in done]


def _start(limit: float, device: str) -> _Worker:
    context = mp.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, limit, device), daemon=True)
    process.start()
    theirs.close()
    return _Worker(process, mine)


def _verdict(worker: _Worker, ready: Sequence[Any], limit: float) -> Verdict | None:
    """The verdict of a worker that has one, or that had to be ended."""
    if worker.cell is None:
        return None
    spent = time.perf_counter() - worker.since
    if worker.pipe in ready:
        try:
            return worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            return Verdict(worker.cell, Outcome.CRASHED, (f"the process ended with code {worker.process.exitcode}",),
                           seconds=spent)
    if spent > FRAMES * LATE * limit + SPARE:
        worker.process.kill()
        worker.process.join()
        return Verdict(worker.cell, Outcome.LATE, (f"no answer within {spent:.0f} s",), seconds=spent)
    return None


def _work(pipe: Connection, limit: float, device: str) -> None:
    while True:
        try:
            cell = pipe.recv()
        except EOFError:
            return
        pipe.send(judge(cell, limit, device))
        if device != "cpu":
            import torch

            gc.collect()
            torch.cuda.empty_cache()  # for the other processes
