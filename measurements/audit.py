"""`vsfsim lab audit TASK`: does a task measure what it says? Three diagnostics of the area by which it ranks, each a
figure or why there is none.

1. Shortcuts: the error of methods that do not look at everything (`baselines/shortcuts.py`) beside the best row, of a
   task that ranks by predicted readings.
2. Ranks: the share of neighbouring rows that differ at 95 % by themselves, and the least difference that is told.
3. Over-fit: Spearman's correlation of the rows with those of the same methods on objects of fresh seeds.

What needs data or further rows ships as `leaderboard/audits/TASK.json`; the ranks are those of the rows that are there.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from vsfsim.bench.board.compare import AREA, ByObject, curve, interval, means, paired
from vsfsim.bench.board.templates import filled
from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.evaluate import evaluate_all
from vsfsim.bench.leaderboard import collect, labels_of
from vsfsim.bench.metrics import Answer, spearman
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import read_record
from vsfsim.bench.task import Task
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError

METHOD = "vsfsim.baselines.shortcuts:Shortcut"
KINDS = ("constant", "action", "view", "touch")
ENOUGH = 0.9
"""Rank correlation with fresh objects from which the rows are not made for the test objects."""
FEWEST_ROWS = 4
"""With fewer rows in common no rank correlation is given."""


@dataclass(frozen=True)
class Shortcut:
    """What one shortcut reaches."""

    sees: str
    """One of `KINDS`."""
    mean: float
    """Of the task's metric over objects, the area under its curve."""
    error: float
    """Its standard error over objects."""
    behind: float
    """Paired difference to the best row over its standard error [-]."""
    beaten: bool
    """The best row is better, at 95 %."""


@dataclass(frozen=True)
class Audit:
    """What was found."""

    task: str
    best: str
    """Method and preset of the best row, "" without rows."""
    shortcuts: tuple[Shortcut, ...]
    rows: int
    """Ranked rows."""
    told: int
    """Neighbouring rows that differ."""
    least: float
    """Median over neighbours of half of the 95 % interval of their difference: the least that is told; NaN for fewer
    than two rows."""
    fresh: tuple[tuple[str, int, float], ...]
    """Of each folder of results on fresh objects: its name, rows in common, rank correlation."""
    errors: Mapping[str, ByObject]
    """The area of each object by shortcut; {} where the data are not here and none ship."""


class Shipped(msgspec.Struct):
    """The file of an audit that ships."""

    format: Literal["vsfsim-audit-2"]
    task_sha256: str
    of: str = ""
    """Digest of the rows, the dataset and the shortcuts that it was made of."""
    fresh: tuple[tuple[str, int, float], ...] = ()
    errors: dict[str, dict[str, float]] = {}


def audit(task: Task, results: Sequence[Path], *, dataset: Path | None = None, fresh: Sequence[Path] = (),
          measure: bool = True, workers: int = 1,
          progress: Callable[[int, int, str], None] = lambda *_: None) -> Audit:
    """Audit a task.

    Args:
        task: the task. results: further result files or folders, beside the rows that ship. dataset: its
        folder, None for the task's. fresh: folders of results of the same methods on objects of other seeds. measure:
        evaluate the shortcuts; else, and without data, they are those that ship, as is ``fresh`` where none are given.
        workers, progress: as of `evaluate`.

    Raises:
        TaskError: a file is not a result of the task.
    """
    ranked = [row for row in collect(task, results).rows if row.rank is not None]
    values = [row.values[AREA] for row in ranked]
    pairs = [paired(worse, better) for better, worse in itertools.pairwise(values)]
    known = shipped(task)
    folder = Path("results") / task.name / "audit"  # of the shortcuts
    errors = (_shortcuts(task, dataset, folder, workers, progress) if measure else {}) or known.errors
    shortcuts = []
    for sees, of in errors.items():
        mine = {name: np.array([[value]]) for name, value in of.items()}
        level, behind = interval(mine), paired(mine, values[0] if values else {})
        shortcuts.append(Shortcut(sees, level.mean, level.error, behind.mean / behind.error if behind.error > 0.0 else
                                  math.nan, behind.told_apart and behind.mean > 0.0))
    areas = {_key(row.result): interval(row.values[AREA]).mean for row in ranked}
    return Audit(task.name, (labels_of(ranked) or [""])[0], tuple(shortcuts), len(ranked),
                 sum(pair.told_apart for pair in pairs),
                 statistics.median(pair.half_width for pair in pairs) if pairs else math.nan,
                 tuple(_agreement(areas, path, task) for path in fresh) or known.fresh, errors)


def shipped(task: Task) -> Shipped:
    """What ships of a task's audit; empty where nothing does, or of another text of the task.

    Raises:
        TaskError: the file is damaged.
    """
    path = shelf.folder("leaderboard") / "audits" / f"{task.name}.json"
    found = read_record(path, Shipped, "audit as `vsfsim lab release` writes it") if path.is_file() else None
    return found if found and found.task_sha256 == task.sha256 else Shipped("vsfsim-audit-2", task.sha256)


def text(found: Audit, board_metric: str) -> str:
    """For a terminal.

    Args:
        found: the audit. board_metric: name of the task's metric, with the shot.
    """
    rows = [[s.sees, f"{s.mean:.3f} ± {s.error:.3f}", f"{s.behind:.1f}" if s.behind == s.behind else ""]
            for s in found.shortcuts]
    return filled("audit.txt", audit=found, metric=board_metric, shortcuts=rows, enough=ENOUGH,
                  fewest=FEWEST_ROWS).rstrip()


def _shortcuts(task: Task, dataset: Path | None, folder: Path, workers: int,
               progress: Callable[[int, int, str], None]) -> dict[str, ByObject]:
    """The area of each object by shortcut; {} where the data are not here, or the task ranks by no readings."""
    if task.metric.answer is not Answer.READINGS or (
            dataset is None and not (task.dataset.path() / "dataset.json").is_file()):
        return {}
    rows, out = {folder / f"shortcut-{sees}.json": Choice(METHOD, "", {"sees": sees}) for sees in KINDS}, {}
    for made in evaluate_all(task, rows, dataset=dataset, workers=workers, progress=progress):
        if made.result is None:
            raise made.failure or TaskError(f"{made.path} was not made.")
        out[made.path] = means(curve(made.result, task)[AREA])
    return {rows[path].parameters["sees"]: out[path] for path in rows}


def _key(result: Result) -> tuple[str, str]:
    return result.method, result.preset


def _agreement(areas: dict[tuple[str, str], float], path: Path, task: Task) -> tuple[str, int, float]:
    """Spearman's correlation of the rows with the results in a folder, NaN for too few in common."""
    files = sorted(path.glob("*.json")) if path.is_dir() else []
    if not files:
        raise TaskError(f"{path} is no folder with result files of `vsfsim evaluate`.")
    other: dict[tuple[str, str], float] = {}
    for result in map(Result.load, files):
        other[_key(result)] = interval(curve(result, task)[AREA]).mean
        if math.isnan(other[_key(result)]):
            raise TaskError(f"a result of {result.method} in {path} has no {task.primary} at some number of touches.")
    both = sorted(areas.keys() & other.keys())
    return path.name, len(both), spearman(*(np.array([of[key] for key in both]) for of in (areas, other))) if (
        len(both) >= FEWEST_ROWS) else math.nan
