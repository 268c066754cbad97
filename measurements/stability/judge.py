"""The verdict on one cell: made in the process that presses it."""

from __future__ import annotations

import tempfile
import time
import traceback
from collections import Counter
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from measurements.stability.checks import PATH, TIER, compare, contradictions
from measurements.stability.design import Cell
from measurements.stability.evidence import Evidence, gather
from vsfsim.core.errors import VsfsimError

SAMPLE = 8  # one cell in so many is also pressed in twice the frames, and another one at tier fem
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
        """For JSON; `of` reads it back."""
        return {**self.cell.table(), **{k: v for k, v in asdict(self).items() if k != "cell"}}

    @classmethod
    def of(cls, table: dict[str, Any]) -> Verdict:
        """The verdict of `table`."""
        rest = {name: table[name] for name in ("frames", "converged", "resolved", "reasons", "seconds", "slowest")}
        return cls(Cell.of(table), Outcome(table["outcome"]), tuple(table["words"]), push=tuple(table["push"]),
                   unchecked=table.get("unchecked", ""), **rest)


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
        return compare(e, gather(cell, folder, limit, device=device, frames=2), PATH, "in twice the frames")
    if draw == 1 and f["tier"] == "fem-coarse" and float(f["depth"]) >= 0.1:
        return compare(e, gather(cell, folder, limit, device=device, tier="fem"), TIER, "at tier fem")
    return []
