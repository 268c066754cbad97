"""`vsfsim leaderboard --html DIR`: the leaderboard as a folder of static pages that work offline.

There is a page a task, a page a method on a task, and a page an object. Everything comes from the boards; pictures of
objects are added where the task's dataset is on this machine.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench import leaderboard
from vsfsim.bench.board.charts import Line, chart, colour_of, png_uri, render, stiffness_map
from vsfsim.bench.board.compare import ByObject, interval, paired
from vsfsim.bench.board.named import command_of
from vsfsim.bench.leaderboard import Board, Row, labels_of, score_cells, unit_of
from vsfsim.bench.metric_functions import object_of, scale_of
from vsfsim.bench.metrics import Answer
from vsfsim.bench.result_file import MAP_ORIGIN, MAP_STEP
from vsfsim.bench.task import Task
from vsfsim.bench.trials.training import models_of
from vsfsim.core.errors import DatasetError, TaskError
from vsfsim.core.shelf import scenes
from vsfsim.core.table import read_text
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.data.provenance import made_by

Cell = str | tuple[str, str]
"""Of a table: text, or a page and the text that leads to it."""
MOST_LINES = 8
"""Methods in a chart, and maps of an object; a table has them all."""
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
        estimates = _estimates(board, names)
        for name in _objects(board):
            pages[_file("object", board.task.name, name)] = _object_page(board, names, name, estimates.get(name, {}))
    for name, text in pages.items():
        write_atomic(out / name, text.encode(), error=TaskError)
    return [out / name for name in pages]


def _file(*words: object) -> str:
    """Name of a page, of letters, digits and dashes."""
    return "-".join(re.sub(r"[^A-Za-z0-9]+", "-", str(word)).strip("-")[:80] or "unnamed" for word in words) + ".html"


def _page(template: str, title: str, **given: Any) -> str:
    return render(template, title=title, today=date.today(), version=made_by()["vsfsim"], **given)


# ---------------------------------------------------------------------- pages


def _index(boards: Sequence[Board]) -> str:
    groups: dict[str, list[list[Cell]]] = {}
    for b in sorted(boards, key=lambda b: ("-mini" in b.task.name, not b.rows, b.task.name)):
        task, first = b.task, [name for row, name in zip(b.rows, labels_of(b.rows), strict=True) if row.rank == 1]
        more = f" and {len(first) - 3} more" if len(first) > 3 else ""
        kind = task.metric.answer.capitalize() + (
            f": {task.observation.name}" if task.metric.answer == Answer.READINGS else "") + (
            ", after touches that the method chooses" if task.protocol.support == "chosen" else "")
        groups.setdefault("Superseded tasks" if task.superseded_by else kind, []).append([
            (_file("task", task.name), task.name), task.description, task.observation.name, str(len(b.rows)),
            ", ".join(first[:3]) + more or "-", *filter(None, [task.superseded_by])])
    order = sorted(groups, key=lambda kind: (kind == "Superseded tasks", not kind.startswith("Readings"), kind))
    return _page("index.html", "vsfsim leaderboard", groups=[(kind, groups[kind]) for kind in order])


def _task_page(board: Board, names: Sequence[str]) -> str:
    task, over, shot = board.task, board.task.protocol.folds, board.task.ranking_shot
    head, cells = leaderboard.cells(board)
    best = next((row for row in board.rows if row.rank == 1), None)
    rows: list[list[Cell]] = [[rank, (_file("method", task.name, number), name), *rest]
                              for number, (rank, name, *rest) in enumerate(cells)]
    if over:
        head.append("difference to the best")
        for row, more in zip(board.rows, rows, strict=True):
            more.append(_difference(row, best, shot))
    ranked = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.objects]
    shown, objects = ranked[:MOST_LINES], _objects(board)
    return _page("task.html", task.name, trail=[HOME], task=task, head=head, rows=rows,
                 notes=leaderboard.footnotes(board), unit=unit_of(task.primary, task.observation.unit),
                 over_touches=_over_touches(task, shown), over_time=_over_time(task, shown), value=_value(task),
                 costs=[[name, *_costs(row)] for row, name in zip(board.rows, names, strict=True)],
                 paper=leaderboard.published(board), shown=[name for _, name in shown],
                 objects=[[_link(task, o), *_numbers([row.objects[shot] for row, _ in shown], o)] for o in objects])


def _method_page(task: Task, row: Row, name: str) -> str:
    at, of = row.objects.get(task.ranking_shot, {}), [row.objects.get(label, {}) for label in task.protocol.labels]
    return _page("method.html", name, trail=_trail(task), row=row, result=row.result, task=task,
                 chart=_over_touches(task, [(row, name)]) if row.objects and task.protocol.folds else "",
                 scores=score_cells(row.result, row.scores, task.primary), value=_value(task),
                 command=command_of(row.result),
                 objects=[[_link(task, o), *_numbers(of, o)] for o in sorted(at, key=lambda o: _sign(task) * at[o])])


def _object_page(board: Board, names: Sequence[str], name: str, estimates: _ByView) -> str:
    task = board.task
    known = sorted((_sign(task) * row.objects[task.ranking_shot][name], number) for number, row in enumerate(board.rows)
                   if name in row.objects.get(task.ranking_shot, {}))
    rows = [[(_file("method", task.name, k), names[k]),
             *_numbers([board.rows[k].objects.get(label, {}) for label in task.protocol.labels], name)]
            for _, k in known]
    return _page("object.html", _called(task, name), trail=_trail(task), task=task, rows=rows,
                 value=_value(task), maps=list(_maps(estimates)), picture=_picture(task, name),
                 colours=", ".join(colour_of(k / 8.0) for k in range(9)))


# ---------------------------------------------------------------------- parts of pages


def _called(task: Task, name: str) -> str:
    """Name of an object with its model, where the task's scene names one."""
    path, number = scenes().get(task.dataset.scene), re.search(r"-(\d+)$", name)
    models = models_of(read_text(path, "scene", TaskError)) if path is not None and path.suffix == ".toml" else []
    return f"{name}, {models[int(number[1]) % len(models)]}" if models and number else name


def _trail(task: Task) -> list[tuple[str, str]]:
    return [HOME, (_file("task", task.name), task.name)]


def _link(task: Task, name: str) -> tuple[str, str]:
    return _file("object", task.name, name), _called(task, name)


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
    lines = [Line(name, [k + 0.04 * (n - 0.5 * (len(rows) - 1)) for k in range(len(labels))],
                  [interval(row.objects.get(label, {})) for label in labels])
             for n, (row, name) in enumerate(rows)]
    return chart(lines, (-0.5, len(labels) - 0.5), across="touches", marks=dict(enumerate(labels)),
                 axis="error over that of zero" if zero else _value(task), level=1.0 if zero else None)


def _over_time(task: Task, rows: Sequence[tuple[Row, str]]) -> str:
    """The means of some rows over the logarithm of the seconds of an adaptation."""
    took = [(row, name, row.result.timing.get("adapt_s", 0.0) / max(row.result.timing.get("adapts", 0.0), 1.0))
            for row, name in rows]
    lines = [Line(name, [math.log10(s)], [interval(row.objects.get(task.ranking_shot, {}))])
             for row, name, s in took if s > 0.0]
    places = [line.x[0] for line in lines] or [0.0]
    low, high = math.floor(min(places)), max(math.ceil(max(places)), math.floor(min(places)) + 1)
    return chart(lines, (low, high), across="seconds of an adaptation", axis=f"at {task.ranking_shot}-shot",
                 marks={power: f"{10.0**power:g}" for power in range(low, high + 1)})


def _value(task: Task) -> str:
    """What the value of one object is."""
    if task.primary == "rmse_ratio":
        return "error over that of predicting zero on the same touches"
    unit = unit_of(task.primary, task.observation.unit)
    return f"{task.primary}{f' [{unit}]' if unit else ''}"


def _sign(task: Task) -> float:
    """Of the ascending order that puts the best value first."""
    return -1.0 if task.metric.higher_is_better else 1.0


def _objects(board: Board) -> list[str]:
    return sorted({name for row in board.rows for values in row.objects.values() for name in values})


_ByView = Mapping[str, list[tuple[str, np.ndarray]]]
"""By object view, what some methods say of it."""


def _estimates(board: Board, names: Sequence[str]) -> dict[str, dict[str, list[tuple[str, np.ndarray]]]]:
    """What the first ranked methods say of the stiffness, by object and view: of each its name and, a row a point,
    place, truth and estimate (k, 5)."""
    out: dict[str, dict[str, list[tuple[str, np.ndarray]]]] = {}
    having = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.result.maps]
    for row, label in having[:MOST_LINES]:
        columns = row.result.maps
        views = np.array(columns["object"])
        values = np.array([columns[key] for key in ("x", "y", "z", "truth", "mean")], float).T
        for view in dict.fromkeys(columns["object"]):
            out.setdefault(object_of(view), {}).setdefault(view, []).append((label, values[views == view]))
    return out


def _maps(estimates: _ByView) -> list[dict[str, Any]]:
    """The truth and the estimates of an object, view by view."""
    out = []
    for view, found in sorted(estimates.items()):
        truth = found[0][1]
        places, true = MAP_STEP * (truth[:, :3] - MAP_ORIGIN), truth[:, 3]
        known = true > 0.0
        if not known.any():
            continue
        low, high = (float(np.quantile(true[known], q)) for q in (0.02, 0.98))
        shown = [("truth", true)] + [(label, array[:, 4] / 10.0 ** scale_of(array[known, 4], true[known]))
                                     for label, array in found if len(array) == len(truth)
                                     and (array[known, 4] > 0.0).any()]
        high = max(high, 1.01 * low)
        out.append({"view": view, "low": f"{low:.3g}", "high": f"{high:.3g}", "pictures": [
            stiffness_map(places, values, low=low, high=high, name=label) for label, values in shown]})
    return out


def _picture(task: Task, name: str) -> tuple[str, str] | None:
    """The photograph of an object and its view, from the task's dataset; None where that is not here."""
    try:
        dataset = Dataset.open(task.dataset.path()).blind()
        view = next(entry.name for entry in dataset.entries if object_of(entry.name) == name)
        return png_uri(dataset[view].view.rgb), view
    except (DatasetError, StopIteration, OSError):
        return None
