"""The verdict on a cell, made in the process that presses it; and on many cells in worker processes: interrupted at any
time, continued later, and ended by a budget of time."""

from __future__ import annotations

import gc
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from measurements.kept import Kept
from measurements.stability.checks import PATH, TIER, compare, contradictions
from measurements.stability.design import Cell
from measurements.stability.evidence import Evidence, gather
from measurements.stability.team import Ended, answers
from vsfsim.core.errors import VsfsimError
from vsfsim.core.table import typed

SAMPLE = 8  # one cell in so many is also pressed in twice the frames, and another one at tier fem
FRAMES = 80  # more than any cell has
SPARE = 180.0  # for meshes, factors and kernels of a cell [s]
LATE = 1.2  # time of a frame over its limit that counts as over the limit [-]


class Outcome(StrEnum):
    """What became of a cell, best first."""

    CONVERGED = "converged"
    UNRESOLVED = "not resolved"
    REFUSED = "refused"
    MARKED = "marked"
    LATE = "over the limit"
    CRASHED = "crashed"
    WRONG = "wrong in silence"

    @property
    def rank(self) -> int:
        """0 for the best."""
        return list(Outcome).index(self)


BAD = (Outcome.WRONG, Outcome.CRASHED, Outcome.LATE)
"""What no cell should become."""


@dataclass(frozen=True)
class Verdict:
    """What became of one cell."""

    cell: Cell
    outcome: Outcome
    words: tuple[str, ...] = ()
    """Contradictions, the refusal, or the traceback."""
    frames: int = 0
    converged: int = 0
    """Of the frames."""
    resolved: int = 0
    """Of the frames, those that converged on a mesh that resolves them."""
    reasons: dict[str, int] = field(default_factory=dict)
    """Frames that are marked, by reason."""
    push: tuple[float | None, ...] = ()
    """Push of every frame [N]; None where it is not a number."""
    seconds: float = 0.0
    """Processor time of the whole cell [s]."""
    slowest: float = 0.0
    """Of its slowest frame [s]."""
    unchecked: str = ""
    """Why the second press of a sampled cell was refused, which leaves the cell without that check; else ""."""

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {"key": self.cell.key, **asdict(self)}


def judge(cell: Cell, limit: float, device: str = "cpu") -> Verdict:
    """Press a cell and check it.

    Args:
        cell: which.
        limit: limit of a frame's processor time [s].
        device: Warp device.
    """
    began = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        try:
            e = gather(cell, Path(folder), limit, device=device)
            words, unchecked = contradictions(e), ""
            try:
                words = words + second_press(cell, e, Path(folder), limit, device)
            except VsfsimError as error:
                unchecked = str(error)
        except VsfsimError as error:
            return Verdict(cell, Outcome.REFUSED, (str(error),), seconds=time.process_time() - began)
        except Exception:
            return Verdict(cell, Outcome.CRASHED, (traceback.format_exc(limit=-4),),
                           seconds=time.process_time() - began)
    slowest = float(np.max(e.seconds, initial=0.0))
    outcome = (Outcome.MARKED if not e.converged.all() else Outcome.UNRESOLVED if not e.resolved.all()
               else Outcome.CONVERGED)
    if slowest > LATE * limit:
        outcome = Outcome.LATE
    if words:
        outcome = Outcome.WRONG
    marked = Counter(reason for reason, good in zip(e.reasons, e.converged, strict=True) if not good)
    return Verdict(cell, outcome, tuple(words), len(e.converged), int(e.converged.sum()), int(e.resolved.sum()),
                   dict(marked), tuple(float(p) if np.isfinite(p) else None for p in e.push),
                   time.process_time() - began, slowest, unchecked)


def second_press(cell: Cell, e: Evidence, folder: Path, limit: float, device: str) -> list[str]:
    """Contradictions between ``e`` and a second press of the same cell.

    A sample of the solids is pressed in twice the frames, another one at tier fem; for the others there is nothing to
    compare.

    Raises:
        VsfsimError: the second press is refused, for its size, say.
    """
    f = cell.factors
    draw = int(cell.key[:4], 16) % SAMPLE
    if cell.kind != "solid" or not e.conservative or not e.converged.all():
        return []
    if draw == 0 and e.large:
        changed, allowed, what = {"frames": 2 * float(f["frames"])}, PATH, "in twice the frames"
    elif draw == 1 and f["tier"] == "fem-coarse" and float(f["depth"]) >= 0.1:
        changed, allowed, what = {"tier": "fem"}, TIER, "at tier fem"
    else:
        return []
    return compare(e, gather(replace(cell, factors={**f, **changed}), folder, limit, device=device), allowed, what)


def run(cells: Sequence[Cell], file: Path, circumstances: Mapping[str, Any], *, workers: int,
        budget: float | None = None, progress: Callable[[int, int, str], None]) -> list[Verdict]:
    """Judge cells, and append each verdict to ``file`` as soon as it is there.

    A process that ends by itself or works longer than all its frames may is ended, and its cell counts as crashed or as
    over the limit.

    Args:
        cells: in the order in which they are made.
        file: see `Kept`.
        circumstances: see `Kept`; ``limit`` of a frame's processor time [s] and Warp ``device`` among them.
        workers: processes.
        budget: time after which no new cell begins [s]; None for none.
        progress: called with (done, in all, what).

    Returns:
        The verdicts of the cells that are done, in the order of ``cells``.

    Raises:
        VsfsimError: see `Kept`.
    """
    lines, limit = Kept(file, circumstances), circumstances["limit"]
    done = {key: typed(row, Verdict, str(file), also=("key",), error=VsfsimError) for key, row in lines.rows.items()}
    waiting = [c for c in cells if c.key not in done]
    for cell, found in answers(waiting, partial(_work, limit=limit, device=circumstances["device"]),
                               workers=workers, most=FRAMES * LATE * limit + SPARE, budget=budget):
        if isinstance(found, Ended):
            outcome = Outcome.LATE if found.late else Outcome.CRASHED
            found = Verdict(cell, outcome, (found.words,), seconds=found.seconds)
        lines.add(found.table())
        done[cell.key] = found
        progress(sum(c.key in done for c in cells), len(cells), "cells")
    return [done[c.key] for c in cells if c.key in done]


def _work(cell: Cell, limit: float, device: str) -> Verdict:
    found = judge(cell, limit, device)
    if device != "cpu":
        import torch

        gc.collect()
        torch.cuda.empty_cache()  # for the other processes
    return found
