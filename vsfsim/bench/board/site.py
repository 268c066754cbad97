"""`vsfsim leaderboard --html DIR`: the leaderboard as a folder of static pages that work offline: a page a task, and a
page a method on a task. Everything comes from the boards."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from vsfsim.bench import leaderboard
from vsfsim.bench.board.charts import chart, render
from vsfsim.bench.board.compare import ByObject, interval, paired
from vsfsim.bench.board.rows import command_of
from vsfsim.bench.leaderboard import Board, Row, labels_of, score_cells, unit_of
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.data.disk import write_atomic
from vsfsim.data.provenance import made_by

Cell = str | tuple[str, str]
"""Of a table: text, or a page and the text that leads to it."""
MOST_LINES = 8
"""Methods in a chart; a table has them all."""
HOME = ("index.html", "leaderboard")


def write_site(boards: Sequence[Board], out: Path,
               progress: Callable[[int, int, str], None] = lambda *_: None) -> list[Path]:
    """Write the pages of some tasks into a folder, which is made if missing.

    Returns:
        The files, index.html first.

    Raises:
        TaskError: the folder or a file of it cannot be written.
    """
    pages: dict[str, str] = {"index.html": _index(boards)}
    for done, board in enumerate(boards):
        progress(done, len(boards), board.task.name)
        names = labels_of(board.rows)
        pages[_file("task", board.task.name)] = _task_page(board, names)
        for number, (row, name) in enumerate(zip(board.rows, names, strict=True)):
            pages[_file("method", board.task.name, number)] = _method_page(board.task, row, name)
    for name, text in pages.items():
        write_atomic(out / name, text.encode(), error=TaskError)
    return [out / name for name in pages]


def _file(*words: object) -> str:
    """Name of a page, of letters, digits and dashes."""
    return "-".join(re.sub(r"[^A-Za-z0-9]+", "-", str(word)).strip("-")[:80] or "unnamed" for word in words) + ".html"


def _page(template: str, title: str, **given: Any) -> str:
    return render(template, title=title, today=date.today(), version=made_by()["vsfsim"], **given)


def _index(boards: Sequence[Board]) -> str:
    rows: list[list[Cell]] = []
    for b in sorted(boards, key=lambda b: (b.task.superseded_by, "-mini" in b.task.name, not b.rows, b.task.name)):
        task, first = b.task, [name for row, name in zip(b.rows, labels_of(b.rows), strict=True) if row.rank == 1]
        more = f" and {len(first) - 3} more" if len(first) > 3 else ""
        rows.append([(_file("task", task.name), task.name), task.description, task.metric.answer.value,
                     task.observation.name, str(len(b.rows)), ", ".join(first[:3]) + more or "-", task.superseded_by])
    return _page("index.html", "vsfsim leaderboard", rows=rows)


def _task_page(board: Board, names: Sequence[str]) -> str:
    task, shot = board.task, board.task.ranking_shot
    head, cells = leaderboard.cells(board)
    best = next((row for row in board.rows if row.rank == 1), None)
    rows: list[list[Cell]] = [[rank, (_file("method", task.name, number), name), *rest]
                              for number, (rank, name, *rest) in enumerate(cells)]
    if task.protocol.folds:
        head.append("difference to the best")
        for row, more in zip(board.rows, rows, strict=True):
            more.append(_difference(row, best, shot))
    shown = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.objects][:MOST_LINES]
    objects = sorted({name for row in board.rows for name in row.objects.get(shot, {})})
    return _page("task.html", task.name, trail=[HOME], task=task, head=head, rows=rows,
                 notes=leaderboard.footnotes(board), unit=unit_of(task.primary, task.observation.unit),
                 over_touches=_over_touches(task, shown), value=_value(task),
                 costs=[[name, *_costs(row)] for row, name in zip(board.rows, names, strict=True)],
                 paper=leaderboard.published(board), shown=[name for _, name in shown],
                 objects=[[o, *_numbers([row.objects[shot] for row, _ in shown], o)] for o in objects])


def _method_page(task: Task, row: Row, name: str) -> str:
    of = [row.objects.get(label, {}) for label in task.protocol.labels]
    at = row.objects.get(task.ranking_shot, {})
    return _page("method.html", name, trail=[HOME, (_file("task", task.name), task.name)], row=row, result=row.result,
                 task=task, value=_value(task), scores=score_cells(row.result, row.scores, task.primary),
                 chart=_over_touches(task, [(row, name)]) if row.objects and task.protocol.folds else "",
                 command=command_of(row.result), objects=[[o, *_numbers(of, o)] for o in sorted(
                     at, key=at.__getitem__, reverse=task.metric.higher_is_better)])


def _numbers(values: Sequence[ByObject], name: str) -> list[str]:
    return [f"{of[name]:.3f}" if name in of else "" for of in values]


def _difference(row: Row, best: Row | None, shot: str) -> str:
    if best is None or row is best or not row.objects.get(shot):
        return ""
    found = paired(row.objects[shot], best.objects[shot])
    return f"{found.mean:+.3f} ± {found.error:.3f}" if found.objects > 1 else ""


def _costs(row: Row) -> list[str]:
    t = row.result.timing
    times = [t[what] / max(t.get(count, 1.0), 1.0) if what in t else math.nan for what, count in (
        ("meta_fit_s", "fits"), ("adapt_s", "adapts"), ("predict_s", "predicts"))]
    return [*("" if s != s else f"{s:.1f} s" if s >= 1.0 else f"{1e3 * s:.0f} ms" for s in times),
            f"{row.result.peak_memory_mib:.0f} MiB" if row.result.peak_memory_mib else "", command_of(row.result)]


def _over_touches(task: Task, rows: Sequence[tuple[Row, str]]) -> str:
    """The means of some rows over the number of touches; the dashed line is predicting zero."""
    zero, labels = task.primary == "rmse_ratio", task.protocol.labels
    lines = [(name, [interval(row.objects.get(label, {})) for label in labels]) for row, name in rows]
    return chart(lines, labels, across="touches", axis="error over that of zero" if zero else _value(task),
                 level=1.0 if zero else None)


def _value(task: Task) -> str:
    """What the value of one object is."""
    if task.primary == "rmse_ratio":
        return "error over that of predicting zero on the same touches"
    unit = unit_of(task.primary, task.observation.unit)
    return f"{task.primary}{f' [{unit}]' if unit else ''}"
