"""A task's table of methods, from the result files."""

from __future__ import annotations

import dataclasses
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from vsfsim.bench.admission.admit import Row, admit
from vsfsim.bench.admission.fingerprint import Record, shipped_record
from vsfsim.bench.board.compare import AREA, LEVEL, Runs, interval, means, ranks, shares, wins
from vsfsim.bench.board.rows import CEILING, CLAIMED, PREDICTIONS, absent, contradicts, is_same, listed
from vsfsim.bench.board.templates import filled
from vsfsim.bench.result import Result, score_text, unit_of
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.core.shelf import folder
from vsfsim.data.provenance import made_by


@dataclass(frozen=True)
class Board:
    """A task's rows, the ranked ones first and best first."""

    task: Task
    """The task."""
    dataset_sha256: str
    """Of the dataset that the ranked results were scored on."""
    record: Record | None
    """Of the task's dataset; None where it ships none."""
    rows: tuple[Row, ...]
    """One row a result."""


def collect(task: Task, paths: Iterable[Path] = (), *, shipped: bool = True) -> Board:
    """Rank the results of ``task``: those shipped in leaderboard/<task>/, unless ``shipped`` is false, and those in
    ``paths`` (files, or folders of them).

    Scores are computed again from the rows of a result (`vsfsim.bench.admission.admit`). One that may not be ranked is
    shown with the reason. The board's dataset is that of the task's record; without one, it is the one that the task
    names, else that of most shipped results (of most results, if none ships). Equal results are one row.

    Raises:
        TaskError: a file is not a result, or is a result of another task.
    """
    own = folder("leaderboard") / task.name
    told = {path: Result.load(path) for path in (*sorted(own.glob("*.json") if shipped else ()), *(
        file for path in paths for file in _files(path)))}
    for path, result in told.items():
        if result.task != task.name:
            raise TaskError(f"{path} is a result of task {result.task}, not of {task.name}.")
    record, entries = shipped_record(task), listed()
    reference = record.dataset_sha256 if record is not None else task.dataset.sha256 or _most(
        [r for path, r in told.items() if path.parent == own], task) or _most(told.values(), task)
    good: list[Row] = []
    odd: list[Row] = []
    for path, result in told.items():
        row = admit(result, path, task, record, reference, entries, made_here=path.parent != own)
        # a shipped result that was made again here, to the same numbers, is one row
        rows = odd if row.mark else good
        same = next((k for k, before in enumerate(rows) if is_same(result, before.result)), None)
        if same is not None:
            if row.origin != "shipped" and rows[same].origin == "shipped":
                rows[same] = dataclasses.replace(rows[same], origin="shipped, made again here")
            continue
        if not row.mark and row.entry is None and any(one.origin != "made here" and contradicts(
                result, one.result, row.values[AREA], one.values[AREA]) for one in good):
            row, rows = dataclasses.replace(row, mark=CLAIMED, other_bits=False), odd
        rows.append(row)
    sign = -1.0 if task.metric.higher_is_better else 1.0
    good.sort(key=lambda row: (sign * interval(row.values[AREA]).mean, row.result.method))
    areas = [row.values[AREA] for row in good]
    ranked = [dataclasses.replace(row, rank=rank, wins=share) for row, rank, share in zip(
        good, ranks(areas), wins(areas, sign), strict=True)]
    return Board(task, reference, record, (*ranked, *odd))


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise TaskError(f"{path} does not exist; give result files of `vsfsim evaluate --out`, or folders of them.")
    return sorted(path.glob("*.json")) if path.is_dir() else [path]


def _most(results: Iterable[Result], task: Task) -> str:
    """The dataset of most results of this very task, "" if there is none."""
    counts = Counter(result.dataset_sha256 for result in results if result.task_sha256 == task.sha256)
    return max(sorted(counts), key=counts.__getitem__, default="")


def labels_of(rows: Sequence[Row]) -> list[str]:
    """The method's name and preset; where it has several rows, with the parameters in which they differ."""
    out = []
    for row in rows:
        result = row.result
        twins = [other.result.parameters for other in rows
                 if (other.result.method, other.result.preset) == (result.method, result.preset)]
        differ = [f"{key}={value}" for key, value in result.parameters.items()
                  if value != "" and any(twin.get(key) != value for twin in twins)]
        words = [*filter(None, ["claimed" if row.mark == CLAIMED else "", result.preset]), *differ]
        out.append(f"{result.method} ({', '.join(words)})" if words else result.method)
    return out


def table(board: Board) -> dict[str, Any]:
    """The board for JSON."""
    task = board.task
    ceiling = possible(board)
    rows = [{"rank": row.rank, "share_of_possible": share_of_possible(row, ceiling),
             "wins": row.wins if row.rank else None, "median": _median(row),
             "method": row.result.method, "parameters": dict(row.result.parameters),
             "origin": row.origin, "evidence": row.evidence, "file": str(row.path),
             "not_ranked_because": row.mark, "objects": {shot: means(of) for shot, of in row.values.items()},
             "scores": {metric: {shot: {"mean": score.mean, "std": score.std} for shot, score in by_shot.items()}
                        for metric, by_shot in row.scores.items()},
             "timing": dict(row.result.timing), "sandbox": row.result.isolation,
             "made_by": dict(row.result.made_by)} for row in board.rows]
    return {"task": task.name, "metric": task.primary, "unit": unit_of(task.primary, task.observation.unit),
            "shares": shares(task), "higher_is_better": task.metric.higher_is_better,
            "dataset_sha256": board.dataset_sha256, "rows": rows}


def text(board: Board) -> str:
    """The board for a terminal; its last column says which results shipped and which were made here."""
    shown = _shown(board)
    origins = [[*row, one.origin] for row, one in zip(shown.pop("rows"), board.rows)]
    return filled("board.txt", rows=origins, **shown).rstrip()


def page(boards: Sequence[Board]) -> str:
    """Some boards as one HTML page that works offline."""
    boards = sorted(boards, key=lambda board: not board.rows)
    return filled("boards.html", boards=list(map(_shown, boards)), charts=list(map(chart, boards)), alone=False,
                  today=date.today(), version=made_by()["vsfsim"])


def _shown(board: Board) -> dict[str, Any]:
    head, rows = cells(board)
    return {"task": board.task, "title": title(board.task), "head": head, "rows": rows, "notes": footnotes(board)}


def chart(board: Board) -> dict[str, Any]:
    """What `chart.svg` draws of a board: the metric after every number of touches of the ceilings and then of each
    ranked method, by its first row; {} where nothing is ranked."""
    task, rows, ceiling = board.task, dict[str, Row](), possible(board)
    for row in sorted((row for row in board.rows if row.rank or row.mark == CEILING), key=lambda row: row.rank or 0):
        rows.setdefault(row.result.method, row)
    if not (ranked := [row for row in rows.values() if row.rank]):
        return {}
    lines = [{"row": row, "area": interval(row.values[AREA]), "at": [
        interval(row.values[label]).mean for label in task.protocol.labels]} for row in rows.values()]
    return {"task": task, "unit": unit_of(task.primary, task.observation.unit), "ceiling": ceiling, "lines": lines,
            "ranked": ranked, "share": share_of_possible(ranked[0], ceiling)}


def title(task: Task) -> str:
    """What the figures of a board are: one line."""
    return filled("title.txt", task=task, unit=unit_of(task.primary, task.observation.unit))


def cells(board: Board, shown: Callable[[str], str] = plain) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of a board; ``shown`` is what becomes of names."""
    task = board.task
    labels = task.protocol.labels
    ceiling = possible(board)
    head = ["#", "method", AREA, *(f"{label}-shot" for label in labels), "median", "wins",
            *(["gap closed"] if ceiling is not None else []), "rank corr.", "evidence"]
    rows, names = [], labels_of(board.rows)
    for row, label in zip(board.rows, names):
        stiffness = row.scores.get("stiffness_spearman", {}).get(task.ranking_shot)
        share, median = share_of_possible(row, ceiling), _median(row)
        rows.append([str(row.rank or "-"), shown(label) + row.signs,
                     *(interval_text(row.values.get(shot, {})) for shot in (AREA, *labels)),
                     "" if median is None else f"{median:.3f}", f"{row.wins:.0%}" if row.wins == row.wins else "",
                     *(["" if share is None else f"{share:.2f}"] if ceiling is not None else []),
                     score_text(stiffness), row.evidence])
    return head, rows


def _median(row: Row) -> float | None:
    """Of the areas of the objects."""
    found = means(row.values.get(AREA, {}))
    return statistics.median(found.values()) if found else None


def possible(board: Board) -> float | None:
    """The mean area of the lowest ceiling that ran at the data's own tier, or of recordings their repeatability; None
    where the board has none, or does not rank by the error over that of predicting zero."""
    if board.record is not None and board.record.repeat and board.task.primary == "rmse_ratio":
        return board.record.repeat
    return min((interval(row.values[AREA]).mean for row in board.rows if row.mark == CEILING
                and board.task.primary == "rmse_ratio" and not row.result.parameters.get("tier")), default=None)


def share_of_possible(row: Row, ceiling: float | None) -> float | None:
    """(1 - e) / (1 - ceiling) of a row's mean area e [-]: 0 predicts zero, 1 is the true object."""
    return (1.0 - interval(row.values[AREA]).mean) / (1.0 - ceiling) if row.values and ceiling is not None else None


def footnotes(board: Board, shown: Callable[[str], str] = plain) -> list[str]:
    """What its columns and signs say, and which rows are not ranked or absent; operands as of `cells`."""
    there = {f"{row.result.method}.{row.result.preset}".rstrip(".") for row in board.rows if row.mark in ("", CEILING)}
    odd = dict.fromkeys(f"{shown(row.result.method)}: {shown(row.mark)}" for row in board.rows if row.mark)
    return filled("notes.txt", board=board, task=board.task, odd=odd, possible=possible(board),
                  absent=absent(board.task.name, there), apart=f"{1.0 - LEVEL:.0%}", predictions=PREDICTIONS,
                  shares=" + ".join(f"{share:.2f} of {label}-shot" for label, share in shares(board.task).items()),
                  correlated=any("stiffness_spearman" in row.scores for row in board.rows), shown=shown).splitlines()


def interval_text(values: Runs) -> str:
    """A mean over objects with its standard error over objects and runs; "" of none."""
    of = interval(values)
    return "" if not of.objects else f"{of.mean:.3f} ± {of.error:.3f}" if of.error == of.error else f"{of.mean:.3f}"
