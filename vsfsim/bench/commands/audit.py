"""`vsfsim lab audit TASK`: does a task measure what it says? Three diagnostics, each a figure or why there is none.

1. Shortcuts: the error of methods that do not look at everything (`baselines/shortcuts.py`) beside the best row.
2. Ranks: the share of neighbouring rows that differ by two standard errors of their paired difference over objects,
   and the least difference that the task can tell.
3. Over-fit: Spearman's correlation of the rows with those of the same methods on objects of a fresh seed.

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

from vsfsim.bench.board.compare import ByObject, Paired, by_object, interval, paired
from vsfsim.bench.board.templates import filled
from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.evaluate import evaluate_all
from vsfsim.bench.leaderboard import collect, labels_of
from vsfsim.bench.metrics import spearman
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import write_atomic

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
    """Of the task's metric over objects, at the shot that ranks."""
    error: float
    """Its standard error over objects."""
    behind: float
    """Paired difference to the best row over its standard error [-]; below 2 nobody is better than the shortcut."""


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
    """Twice the median standard error of a paired difference between neighbours: the least that is told; NaN for fewer
    than two rows."""
    fresh: tuple[tuple[str, int, float], ...]
    """Of each folder of results on fresh objects: its name, rows in common, rank correlation."""
    errors: Mapping[str, ByObject]
    """The task's metric of each object by shortcut, at the shot that ranks; {} where the data are not here and none
    ship."""

    def ship(self, path: Path, task_sha256: str) -> None:
        """Write what needs data or further rows.

        Raises:
            TaskError: the file cannot be written.
        """
        errors = {sees: {name: float(f"{value:.7g}") for name, value in of.items()} for sees, of in self.errors.items()}
        told = msgspec.json.encode(_Shipped("vsfsim-audit", task_sha256, self.fresh, errors))
        write_atomic(path, msgspec.json.format(told, indent=1) + b"\n", error=TaskError)


class _Shipped(msgspec.Struct):
    format: Literal["vsfsim-audit"]
    task_sha256: str
    fresh: tuple[tuple[str, int, float], ...] = ()
    errors: dict[str, dict[str, float]] = {}


def audit(task: Task, results: Sequence[Path], *, dataset: Path | None = None, fresh: Sequence[Path] = (),
          folder: Path | None = None, measure: bool = True,
          progress: Callable[[int, int, str], None] = lambda *_: None) -> Audit:
    """Audit a task.

    Args:
        task: with cross-validation. results: further result files or folders, beside the rows that ship. dataset: its
        folder, None for the task's. fresh: folders of results of the same methods on objects of other seeds. folder:
        where the results of shortcuts are kept; None for results/TASK/audit. measure: evaluate the shortcuts; else, and
        without data, they are those that ship, as is ``fresh`` where none are given. progress: as of `evaluate`.

    Raises:
        TaskError: the task is not scored object by object, or a file is not its result.
    """
    if not task.protocol.folds or task.metric.higher_is_better:
        raise TaskError(f"task {task.name} is not audited: it needs cross-validation, in which every object has an "
                        f"error of its own ([protocol] folds).")
    ranked = [row for row in collect(task, results).rows if row.rank is not None]
    values = [row.objects[task.ranking_shot] for row in ranked]
    pairs = [paired(worse, better) for better, worse in itertools.pairwise(values)]
    known = _shipped(task)
    errors = (_shortcuts(task, dataset, folder or Path("results") / task.name / "audit", progress) if measure else
              {}) or known.errors
    shortcuts = []
    for sees, of in errors.items():
        behind = paired(of, values[0]) if values else Paired(math.nan, math.nan, 0)
        shortcuts.append(Shortcut(sees, *interval(of), behind.mean / behind.error if behind.error > 0.0 else math.nan))
    means = {_key(row.result): row.scores[task.primary][task.ranking_shot].mean for row in ranked}
    return Audit(task.name, (labels_of(ranked) or [""])[0], tuple(shortcuts), len(ranked),
                 sum(pair.told_apart for pair in pairs),
                 2.0 * statistics.median(pair.error for pair in pairs) if pairs else math.nan,
                 tuple(_agreement(means, path, task) for path in fresh) or known.fresh, errors)


def _shipped(task: Task) -> _Shipped:
    """What ships of a task's audit; empty where nothing does, or of another text of the task.

    Raises:
        TaskError: the file is damaged.
    """
    path, nothing = shelf.folder("leaderboard") / "audits" / f"{task.name}.json", _Shipped("vsfsim-audit", task.sha256)
    if not path.is_file():
        return nothing
    try:
        found = msgspec.json.decode(path.read_bytes(), type=_Shipped)
    except (OSError, msgspec.MsgspecError) as error:
        raise TaskError(f"{path} is not what `vsfsim lab release` wrote: {plain(error)}. Restore the file.") from error
    return found if found.task_sha256 == task.sha256 else nothing


def text(found: Audit, board_metric: str) -> str:
    """For a terminal.

    Args:
        found: the audit. board_metric: name of the task's metric, with the shot.
    """
    rows = [[s.sees, f"{s.mean:.3f} ± {s.error:.3f}", f"{s.behind:.1f}" if s.behind == s.behind else ""]
            for s in found.shortcuts]
    return filled("audit.txt", audit=found, metric=board_metric, shortcuts=rows, enough=ENOUGH,
                  fewest=FEWEST_ROWS).rstrip()


def _shortcuts(task: Task, dataset: Path | None, folder: Path, progress: Callable[[int, int, str], None]
               ) -> dict[str, ByObject]:
    """The metric of each object by shortcut; {} where the data are not here."""
    if dataset is None and not (task.dataset.path() / "dataset.json").is_file():
        return {}
    rows, out = {folder / f"shortcut-{sees}.json": Choice(METHOD, "", {"sees": sees}) for sees in KINDS}, {}
    for made in evaluate_all(task, rows, dataset=dataset, progress=progress):
        if made.result is None:
            raise made.failure or TaskError(f"{made.path} was not made.")
        out[made.path] = by_object(made.result, task.primary, task.ranking_shot)
    return {rows[path].parameters["sees"]: out[path] for path in rows}


def _key(result: Result) -> tuple[str, str]:
    return result.method, result.preset


def _agreement(means: dict[tuple[str, str], float], path: Path, task: Task) -> tuple[str, int, float]:
    """Spearman's correlation of the rows with the results in a folder, NaN for too few in common."""
    files = sorted(path.glob("*.json")) if path.is_dir() else []
    if not files:
        raise TaskError(f"{path} is no folder with result files of `vsfsim evaluate`.")
    other: dict[tuple[str, str], float] = {}
    for result in map(Result.load, files):
        score = result.scores.get(task.primary, {}).get(task.ranking_shot)
        if score is None:
            raise TaskError(f"a result of {result.method} in {path} has no {task.primary} at {task.ranking_shot}-shot.")
        other[_key(result)] = score.mean
    both = sorted(means.keys() & other.keys())
    return path.name, len(both), spearman(*(np.array([of[key] for key in both]) for of in (means, other))) if (
        len(both) >= FEWEST_ROWS) else math.nan
