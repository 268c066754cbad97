"""A task's table of methods, from the result files."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vsfsim.bench.metrics import METRICS, Answer, metrics_of
from vsfsim.bench.result import Result, Score, readings_apart
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import folder
from vsfsim.core.text_table import text_table

_SAME_READINGS = 1e-3
"""Datasets whose readings differ by less, by `result.readings_apart`, count as the same dataset made on a machine with
other rounding: an error changes by about that fraction of the readings at most. Rounding alone gives 1e-8 where a touch
has a unique equilibrium; other seeds, scenes or physics differ by tens of per cent."""
_SAME_SCORE = 1e-4
"""Relative difference below which two scores on such datasets count as one result."""


@dataclass(frozen=True)
class Row:
    """One method."""

    rank: int | None
    """From 1; None where the result may not be ranked."""
    mark: str
    """Why it is not ranked, or ""."""
    result: Result
    """The result."""
    path: Path
    """Its file."""
    apart: float | None
    """Relative difference between the readings of its dataset and those of the board's dataset [-]: 0 where both have
    the same bits, None where it is not known."""


@dataclass(frozen=True)
class Board:
    """A task's rows, the ranked ones first and best first."""

    task: Task
    """The task."""
    dataset_sha256: str
    """Of the dataset that the ranked results were scored on."""
    rows: tuple[Row, ...]
    """One row a result."""


def collect(task: Task, paths: Iterable[Path] = ()) -> Board:
    """Rank the results of ``task``: those shipped in leaderboard/<task>/ and those in ``paths`` (files, or folders of
    them).

    A result on another dataset or of another text of the task is shown and marked, but not ranked, because its numbers
    are not comparable. The board's dataset is the one that the task names, else that of most shipped results (of most
    results, if none ships). A dataset with other bits is the same if its readings are (`_SAME_READINGS`): the same
    command made it on another machine. Equal results are one row.

    Raises:
        TaskError: a file is not a result, or is a result of another task.
    """
    shipped = sorted((folder("leaderboard") / task.name).glob("*.json"))
    files = list(shipped)
    for path in paths:
        if not path.exists():
            raise TaskError(f"{path} does not exist; give result files of `vsfsim evaluate --out`, or folders of them.")
        files += sorted(path.glob("*.json")) if path.is_dir() else [path]
    results = [(path, Result.load(path)) for path in dict.fromkeys(files)]
    for path, result in results:
        if result.task != task.name:
            raise TaskError(f"{path} is a result of task {result.task}, not of {task.name}.")
    reference = task.dataset.sha256 or _most([r for path, r in results if path in shipped],
                                             task) or _most([r for _, r in results], task)
    known = next((r.readings for _, r in results if r.dataset_sha256 == reference and r.readings), {})
    good: list[tuple[Path, Result, str, float | None]] = []
    odd: list[tuple[Path, Result, str, float | None]] = []
    for path, result in results:
        apart = 0.0 if result.dataset_sha256 == reference else readings_apart(result.readings, known)
        mark = _mark(result, task, apart)
        # a shipped result that was made again here, to the same numbers, is one row
        if not any(_is_same(result, before) for _, before, *_ in (odd if mark else good)):
            (odd if mark else good).append((path, result, mark, apart))
    sign = -1.0 if task.metric.higher_is_better else 1.0
    good.sort(key=lambda item: (sign * item[1].scores[task.primary][task.ranking_shot].mean, item[1].method))
    rows = [Row(i, "", result, path, apart) for i, (path, result, _, apart) in enumerate(good, start=1)]
    rows += [Row(None, mark, result, path, apart) for path, result, mark, apart in odd]
    return Board(task, reference, tuple(rows))


def _most(results: list[Result], task: Task) -> str:
    """The dataset of most results of this very task, "" if there is none."""
    counts = Counter(result.dataset_sha256 for result in results if result.task_sha256 == task.sha256)
    return max(sorted(counts), key=counts.__getitem__, default="")


def _is_same(result: Result, before: Result) -> bool:
    """Whether two results are the same one. One of them may be older than a parameter, or from a machine with other
    rounding; the scores decide."""
    known = result.parameters.keys() & before.parameters.keys()
    if (result.method, result.task_sha256) != (before.method, before.task_sha256):
        return False
    if any(result.parameters[key] != before.parameters[key] for key in known):
        return False
    if result.dataset_sha256 == before.dataset_sha256:
        return repr(result.scores) == repr(before.scores)
    apart = readings_apart(result.readings, before.readings)
    if apart is None or not apart < _SAME_READINGS or result.scores.keys() != before.scores.keys():
        return False
    names = [metric.name for metric in metrics_of(Answer.READINGS) if metric.name in result.scores]
    pairs = [pair for name in names for shot, score in result.scores[name].items()
             for pair in zip(score.per_seed, before.scores[name][shot].per_seed, strict=False)]
    return all(math.isclose(one, other, rel_tol=_SAME_SCORE) for one, other in pairs)


def _mark(result: Result, task: Task, apart: float | None) -> str:
    if result.task_sha256 != task.sha256:
        return "other text of the task"
    if apart is None or not apart < _SAME_READINGS:
        difference = "" if apart is None else f", its readings are {100.0 * apart:.2g} % off"
        return f"other dataset ({result.dataset_sha256[:12]}{difference})"
    if task.primary not in result.scores or task.ranking_shot not in result.scores[task.primary]:
        return f"no {task.primary} at {task.ranking_shot}-shot"
    return ""


def text(board: Board) -> str:
    """The board for a terminal."""
    head, rows = _cells(board)
    lines = [_title(board), "", text_table(head, rows)]
    lines += _footnotes(board)
    paper = _paper(board)
    if paper:
        lines += ["", "From the literature (not comparable: other data or another quantity, see the unit):",
                  text_table(paper[0], paper[1:])]
    return "\n".join(lines)


def markdown(board: Board) -> str:
    """The board as a page."""
    head, rows = _cells(board)
    lines = [f"# {board.task.name}", "", board.task.description, "", _title(board), "", *_piped([head, *rows])]
    lines += ["", *_footnotes(board)]
    paper = _paper(board)
    if paper:
        lines += ["", "From the literature, as context only (not comparable: other data or another quantity, "
                      "see the unit):", "", *_piped(paper)]
    return "\n".join(lines).rstrip() + "\n"


def score_table(result: Result, metric: str) -> str:
    """One result for a terminal: every metric by shot."""
    head = [f"{result.method}", *(f"{label}-shot" for label in result.shots)]
    # A method without the function that the task ranks by has no such row.
    order = [*(m for m in (metric,) if m in result.scores), *(m for m in result.scores if m != metric)]
    rows = []
    for name in order:
        unit = _unit(name, result.unit)
        rows.append([f"{name} [{unit}]" if unit else name,
                     *(_number(result.scores[name].get(label)) for label in result.shots)])
    return text_table(head, rows)


def _unit(metric: str, of_reading: str) -> str:
    """Of a metric, "" for a pure number and for one that this version does not know."""
    unit = METRICS[metric].unit if metric in METRICS else ""
    return of_reading if unit is None else unit


def _title(board: Board) -> str:
    task = board.task
    unit = _unit(task.primary, task.observation.unit) or "-"
    what = f"{'of' if task.metric.answer is Answer.READINGS else 'from'} {task.observation.name}"
    better = "higher" if task.metric.higher_is_better else "lower"
    return (f"{task.primary} {what} [{unit}], mean ± std over seeds, {better} is better; ranked at "
            f"{task.ranking_shot}-shot")


def _cells(board: Board) -> tuple[list[str], list[list[str]]]:
    task = board.task
    labels = task.protocol.labels
    head = ["#", "method", *(f"{label}-shot" for label in labels), "rank corr.", "adapt", "vsfsim"]
    rows, labels_of = [], _labels([row.result for row in board.rows])
    for row, label in zip(board.rows, labels_of):
        by_shot = row.result.scores.get(task.primary, {})
        stiffness = row.result.scores.get("stiffness_spearman", {}).get(task.ranking_shot)
        adapt = row.result.timing.get("adapt_s", 0.0) / max(row.result.timing.get("adapts", 0), 1)
        commit = str(row.result.made_by.get("commit") or "")[:7]
        rows.append([str(row.rank or "-"), label + (" *" if row.mark else " ~" if row.apart else ""),
                     *(_number(by_shot.get(shot)) for shot in labels),
                     _number(stiffness), f"{adapt:.2f} s", f"{row.result.made_by.get('vsfsim')} {commit}".strip()])
    return head, rows


def _labels(results: list[Result]) -> list[str]:
    """The method's name; where it has several rows, with the parameters in which they differ."""
    out = []
    for result in results:
        twins = [other.parameters for other in results if other.method == result.method]
        differ = [f"{key}={value}" for key, value in result.parameters.items()
                  if any(twin.get(key) != value for twin in twins)]
        out.append(f"{result.method} ({', '.join(differ)})" if differ else result.method)
    return out


def _footnotes(board: Board) -> list[str]:
    lines = [f"* {row.result.method}: {row.mark}, not ranked" for row in board.rows if row.mark]
    rounded = [row.apart for row in board.rows if row.apart and not row.mark]
    if rounded:
        lines.append(f"~ on the same dataset made on a machine that rounds otherwise; its readings are "
                     f"{100.0 * max(rounded):.1g} % off at most")
    if not board.rows:
        lines.append("no results yet; `vsfsim evaluate --method NAME --task " + board.task.name
                     + " --out FILE` makes one")
    elif any("stiffness_spearman" in row.result.scores for row in board.rows):
        lines.append(f"rank corr.: Spearman's, of the stiffness estimate at {board.task.ranking_shot}-shot with the "
                     f"true probe stiffness where touched")
    return lines


def _paper(board: Board) -> list[list[str]]:
    labels = board.task.protocol.labels
    rows = [[row.method, *(_pair(row.values.get(label)) for label in labels), row.unit,
             row.source + ("" if row.comparable else " (not comparable)")]
            for row in board.task.paper]
    return [["method", *(f"{label}-shot" for label in labels), "unit", "source"], *rows] if rows else []


def _number(score: Score | None) -> str:
    return "" if score is None else f"{score.mean:.3f} ± {score.std:.3f}"


def _pair(value: tuple[float, float | None] | None) -> str:
    if value is None:
        return ""
    return f"{value[0]:.2f}" + ("" if value[1] is None else f" ± {value[1]:.2f}")


def _piped(rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]
