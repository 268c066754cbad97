"""`vsfsim leaderboard --html DIR`: the leaderboard as a folder of static pages that work offline.

There is a page a task, a page a method on a task, and a page an object. Everything comes from the boards; pictures of
objects are added where the task's dataset is on this machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from datetime import date
from pathlib import Path

import numpy as np

from vsfsim.bench import leaderboard
from vsfsim.bench.board import charts
from vsfsim.bench.board.compare import interval, paired
from vsfsim.bench.board.markup import Cell, escape, figure, file_name, link, page, paragraph, table
from vsfsim.bench.board.named import EARLIER, command_of, labels_of
from vsfsim.bench.leaderboard import Board, Row, column_notes, over_objects, possible, share_text, superseded, unit_of
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

_COLUMNS = ("stiffness: Spearman's rank correlation of the estimate with the true probe stiffness where touched. 50 % "
            "and 90 %: fraction of readings within the central interval that the method gives; right are 0.5 and 0.9.")
_TIMES = "Meta-fit: time of a training; adapt and predict: of a new object and of a touch."

Progress = Callable[[int, int, str], None]
ByView = dict[str, list[tuple[str, np.ndarray]]]
"""By object view, what some methods say of it."""
MOST_LINES = 8
"""Methods in a chart, and maps of an object; a table has them all."""


def write_site(boards: Sequence[Board], out: Path, progress: Progress = lambda *_: None) -> list[Path]:
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
        pages[_of_task(board.task)] = _task_page(board, names)
        for number, (row, name) in enumerate(zip(board.rows, names, strict=True)):
            pages[_of_method(board.task, number)] = _method_page(board, row, name)
        estimates = _estimates(board, names)
        for name in _objects(board):
            pages[_of_object(board.task, name)] = _object_page(board, names, name, estimates.get(name, {}))
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TaskError(f"folder {out} cannot be made: {error.strerror}. Choose another --html.") from error
    for name, text in pages.items():
        write_atomic(out / name, text.encode(), error=TaskError)
    return [out / name for name in pages]


def _of_task(task: Task) -> str:
    return file_name("task", task.name)


def _of_method(task: Task, number: int) -> str:
    return file_name("method", task.name, number)


def _of_object(task: Task, name: str) -> str:
    return file_name("object", task.name, name)


# ---------------------------------------------------------------------- pages


def _index(boards: Sequence[Board]) -> str:
    body = [paragraph("Estimators of the stiffness of deformable objects from vision and touch, scored on simulated "
                      "data. Every number here is computed again from the rows of a result file. First are the methods "
                      "of rank 1; methods that cannot be told apart share a rank.")]
    head = ["task", "what is predicted", "reading", "rows", "first"]
    current = [board for board in boards if not board.task.superseded_by]
    old = [board for board in boards if board.task.superseded_by]
    questions = {_question(board.task) for board in current}
    for question in sorted(questions, key=lambda q: (not q.startswith("Readings"), q)):
        asked = [board for board in current if _question(board.task) == question]
        rows = [_index_row(b) for b in sorted(asked, key=lambda b: ("-mini" in b.task.name, not b.rows, b.task.name))]
        body += [f"<h2>{escape(question)}</h2>", table(head, rows, text=(0, 2), long=(1, 4))]
    if old:
        rows = [[*_index_row(b), b.task.superseded_by or ""] for b in sorted(old, key=lambda b: b.task.name)]
        body += ["<h2>Superseded tasks</h2>", table([*head, "superseded by"], rows, text=(0, 2, 5), long=(1, 4))]
    return page("vsfsim leaderboard", body, foot=_foot())


def _question(task: Task) -> str:
    """What a task asks, as a heading of the first page."""
    answer = task.metric.answer
    what = f"{answer.capitalize()}: {task.observation.name}" if answer == Answer.READINGS else answer.capitalize()
    return f"{what}, after touches that the method chooses" if task.protocol.chosen else what


def _foot() -> str:
    """Date, version, how to put a row here, licence and citation."""
    return paragraph(f"Made on {date.today()} with vsfsim {made_by()['vsfsim']}. A row of your own: evaluate --method "
                     f"NAME --task TASK, then vsfsim submit RESULT. Results are under the licence of the repository, "
                     f"Apache 2.0. Please cite it (CITATION.cff) and the papers of the methods.", note=True)


def _index_row(board: Board) -> list[Cell]:
    first = [row for row in board.rows if row.rank == 1]
    names = dict(zip(map(id, board.rows), labels_of(board.rows), strict=True))
    more = f" and {len(first) - 3} more" if len(first) > 3 else ""
    best = ", ".join(names[id(row)] for row in first[:3]) + more
    return [link(_of_task(board.task), board.task.name), board.task.description, board.task.observation.name,
            str(len(board.rows)), best or "-"]


def _task_page(board: Board, names: Sequence[str]) -> str:
    task, labels = board.task, board.task.protocol.labels
    over, ceiling = over_objects(board.task), possible(board)
    head = ["rank", "method", *(f"{label}-shot" for label in labels), *(["of possible"] if ceiling else []),
            *(["difference to the best"] if over else []), "stiffness", "50 %", "90 %", "evidence"]
    rows = list[list[Cell]]()
    best = next((row for row in board.rows if row.rank == 1), None)
    for number, (row, name) in enumerate(zip(board.rows, names, strict=True)):
        rows.append([str(row.rank or "-"), link(_of_method(task, number), name + row.signs.replace(" *", "")),
                     *(_cell(row, task, label) for label in labels),
                     *([share_text(row, ceiling, task.ranking_shot)] if ceiling else []),
                     *([_difference(row, best, task)] if over else []), *_other_scores(row, task), row.evidence])
    body = [paragraph(task.description),
            *([paragraph(f"This task is {superseded(task)}.")] if task.superseded_by else [])]
    body += [paragraph(_how(board), note=True),
             table(head, rows, text=(1, len(head) - 1), caption=_COLUMNS)]
    body += [paragraph(f"{line}.", note=True) for line in column_notes(board)]
    body += [paragraph(f"{name} is not ranked: {row.mark}.", note=True)
             for row, name in zip(board.rows, names, strict=True) if row.mark not in ("", EARLIER)]
    if over:
        body += _comparison(board, names)
    costs: list[list[Cell]] = [[name, *_costs(row)] for row, name in zip(board.rows, names, strict=True)]
    if costs:
        body += ["<h2>Time, memory, and how each row was made</h2>",
                 table(["method", "meta-fit", "adapt", "predict", "memory", "sandbox", "command"], costs,
                       text=(0, 5), long=(6,), caption=_TIMES)]
    body += _literature(board)
    objects = _objects(board)
    if objects:
        body += ["<h2>Objects</h2>", _object_table(board, names, objects)]
    return page(task.name, body, trail=[link("index.html", "leaderboard")], foot=_foot())


def _method_page(board: Board, row: Row, name: str) -> str:
    task, result = board.task, row.result
    labels = task.protocol.labels
    scores = [[f"{metric} [{unit}]" if (unit := unit_of(metric, task.observation.unit)) else metric,
               *(leaderboard.score_text(by_shot.get(label)) for label in labels)]
              for metric, by_shot in row.scores.items()]
    body = [paragraph(f"{result.entry} on {task.name}; {f'rank {row.rank}' if row.rank else f'not ranked: {row.mark}'}."
                      f" The file is {row.path.name} ({row.origin}).")]
    if row.objects and over_objects(board.task):
        series = [charts.Series(name, [interval(row.objects.get(label, {})) for label in labels])]
        body.append(_over_touches(task, series, "Mean over objects and its standard error"))
    body += ["<h2>Scores</h2>", table(["metric", *(f"{label}-shot" for label in labels)], scores,
                                      caption=f"mean ± std over {len(result.seeds)} runs")]
    if row.objects:
        at = row.objects.get(task.ranking_shot, {})
        body += ["<h2>Objects</h2>", table(
            ["object", *(f"{label}-shot" for label in labels)],
            [[link(_of_object(task, o), _called(task, o)),
              *(f"{row.objects[label][o]:.3f}" if o in row.objects.get(label, {}) else "" for label in labels)]
             for o in sorted(at, key=lambda o: _sign(task) * at[o])],
            caption=f"{_value(task)}, mean over runs; the best first")]
    body += ["<h2>Made with</h2>", table(["parameter", "value"], [[k, str(v)] for k, v in result.parameters.items()],
                                         text=(0, 1)),
             table(["", "value"], [["preset", result.preset or "none"],
                                   ["package", f"{result.package.get('name', '')} {result.package.get('version', '')}"],
                                   ["vsfsim", f"{result.made_by.get('vsfsim')} {result.made_by.get('commit') or ''}"],
                                   ["machine", f"{result.machine.get('cpu')}, {result.machine.get('cores')} cores"],
                                   ["sandbox", result.isolation or "not run here"],
                                   ["command", command_of(result)]], text=(0,), long=(1,))]
    body += [paragraph(f"Note: {note}.", note=True) for note in result.notes]
    return page(f"{name}", body, trail=[link("index.html", "leaderboard"), link(_of_task(task), task.name)],
                foot=_foot())


def _object_page(board: Board, names: Sequence[str], name: str, estimates: ByView) -> str:
    task, labels = board.task, board.task.protocol.labels
    known = [(row.objects[task.ranking_shot][name], number) for number, row in enumerate(board.rows)
             if name in row.objects.get(task.ranking_shot, {})]
    rows: list[list[Cell]] = [
        [link(_of_method(task, number), names[number]),
         *(f"{value[name]:.3f}" if name in (value := board.rows[number].objects.get(shot, {})) else ""
           for shot in labels)] for _, number in sorted(known, key=lambda one: _sign(task) * one[0])]
    body = [_picture(task, name), "<h2>Methods</h2>",
            table(["method", *(f"{label}-shot" for label in labels)], rows,
                  caption=f"{_value(task)}, mean over runs; the best first")]
    maps = _maps(estimates)
    if maps:
        body += [f"<h2>Stiffness after {task.ranking_shot} touches</h2>",
                 paragraph("Every point is a place where a small cone measured the true stiffness and that some touch "
                           "reached. The truth comes first; an estimate is scaled by one factor an object.", note=True),
                 *maps]
    return page(_called(task, name), body, trail=[link("index.html", "leaderboard"), link(_of_task(task), task.name)],
                foot=_foot())


# ---------------------------------------------------------------------- parts of pages


def _called(task: Task, name: str) -> str:
    """Name of an object with its model, where the task's scene names one."""
    path, number = scenes().get(task.dataset.scene), re.search(r"-(\d+)$", name)
    models = models_of(read_text(path, "scene", TaskError)) if path is not None and path.suffix == ".toml" else []
    return f"{name}, {models[int(number[1]) % len(models)]}" if models and number else name


def _how(board: Board) -> str:
    task, protocol = board.task, board.task.protocol
    unit = unit_of(task.primary, task.observation.unit)
    what = f"{task.primary}{f' [{unit}]' if unit else ''} at {task.ranking_shot}-shot ranks; " + (
        "higher is better" if task.metric.higher_is_better else "lower is better")
    if not over_objects(board.task):
        return f"{what}. Mean ± standard deviation over {protocol.seeds} seeds."
    return (f"{what}. An object's value is its {_value(task)}. Mean ± standard error over objects: each is a test "
            f"object once ({protocol.folds} folds, {protocol.draws} draws of the support, {protocol.trainings} "
            f"trainings). Methods share a rank if their paired difference is below two standard errors.")


def _cell(row: Row, task: Task, label: str) -> str:
    if row.objects.get(label):
        return leaderboard.interval_text(row.objects[label])
    return leaderboard.score_text(row.scores.get(task.primary, {}).get(label))


def _difference(row: Row, best: Row | None, task: Task) -> str:
    if best is None or row is best or not row.objects.get(task.ranking_shot):
        return ""
    found = paired(row.objects[task.ranking_shot], best.objects[task.ranking_shot])
    return f"{found.mean:+.3f} ± {found.error:.3f}" if found.objects > 1 else ""


def _other_scores(row: Row, task: Task) -> list[str]:
    found = [row.scores.get(metric, {}).get(task.ranking_shot)
             for metric in ("stiffness_spearman", "coverage50", "coverage90")]
    return ["" if score is None else f"{score.mean:.2f}" for score in found]


def _costs(row: Row) -> list[str]:
    t = row.result.timing
    per = [("meta_fit_s", "fits"), ("adapt_s", "adapts"), ("predict_s", "predicts")]
    times = [_seconds(t[what] / max(t.get(count, 1.0), 1.0)) if what in t else "" for what, count in per]
    return [*times, f"{row.result.peak_memory_mib:.0f} MiB" if row.result.peak_memory_mib else "",
            row.result.isolation or "not run here", command_of(row.result)]


def _seconds(value: float) -> str:
    return f"{value:.1f} s" if value >= 1.0 else f"{1e3 * value:.0f} ms"


def _comparison(board: Board, names: Sequence[str]) -> list[str]:
    task, labels = board.task, board.task.protocol.labels
    ranked = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.objects]
    series = [charts.Series(name, [interval(row.objects.get(label, {})) for label in labels])
              for row, name in ranked[:MOST_LINES]]
    costs = {name: (row.result.timing.get("adapt_s", 0.0) / max(row.result.timing.get("adapts", 0.0), 1.0),
                    *interval(row.objects.get(task.ranking_shot, {}))) for row, name in ranked}
    what = "Error" if _sign(task) > 0.0 else "Score"
    shown = _value(task)
    return [f"<h2>{what} over touches</h2>",
            _over_touches(task, series, f"Mean over objects and its standard error of the first {len(series)} rows"),
            f"<h2>{what} over time</h2>",
            figure(charts.points(costs, across="seconds of an adaptation",
                                 axis=f"{what.lower()} at {task.ranking_shot}-shot"),
                   f"{shown[0].upper()}{shown[1:]}, against the time of adapting to a new object.")]


def _over_touches(task: Task, series: Sequence[charts.Series], caption: str) -> str:
    zero = task.primary == "rmse_ratio"
    unit = unit_of(task.primary, task.observation.unit)
    axis = "error over that of zero" if zero else f"{task.primary}{f' [{unit}]' if unit else ''}"
    return figure(charts.lines(task.protocol.labels, series, axis=axis, below="touches", level=1.0 if zero else None),
                  caption + ("; the dashed line is predicting zero." if zero else "."))


def _value(task: Task) -> str:
    """What the value of one object is."""
    if task.primary == "rmse_ratio":
        return "error over that of predicting zero on the same touches"
    unit = unit_of(task.primary, task.observation.unit)
    return f"{task.primary}{f' [{unit}]' if unit else ''}"


def _sign(task: Task) -> float:
    """Of the ascending order that puts the best value first."""
    return -1.0 if task.metric.higher_is_better else 1.0


def _literature(board: Board) -> list[str]:
    task, labels = board.task, board.task.protocol.labels
    if not task.paper:
        return []
    zero = {row.unit: row.values["0"][0] for row in task.paper if "(zero)" in row.method and "0" in row.values}
    rows: list[list[Cell]] = []
    for row in task.paper:
        unit = zero.get(row.unit)
        cells = [_published(row.values.get(label), unit) for label in labels]
        rows.append([row.method, *cells, row.unit, row.source, "yes" if row.comparable else "no"])
    caption = "Real objects: another sensor, other objects; the numbers are context."
    if zero:
        caption += (" In brackets: over the 0-shot error of the paper's zero Gaussian prior, which predicts zero; that "
                    "compares with our ratios.")
    n = len(labels)
    return ["<h2>The papers' figures</h2>",
            table(["method", *(f"{label}-shot" for label in labels), "unit", "source", "comparable"], rows,
                  text=(0, n + 1, n + 2, n + 3), caption=caption)]


def _published(value: tuple[float, float | None] | None, zero: float | None) -> str:
    if value is None:
        return ""
    spread = "" if value[1] is None else f" ± {value[1]:.2f}"
    return f"{value[0]:.2f}{spread}" + (f" ({value[0] / zero:.2f})" if zero else "")


def _objects(board: Board) -> list[str]:
    return sorted({name for row in board.rows for values in row.objects.values() for name in values})


def _object_table(board: Board, names: Sequence[str], objects: Sequence[str]) -> str:
    task = board.task
    ranked = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.objects][:MOST_LINES]
    rows: list[list[Cell]] = [[link(_of_object(task, o), _called(task, o)),
                               *(f"{row.objects[task.ranking_shot][o]:.3f}" for row, _ in ranked)] for o in objects]
    return table(["object", *(name for _, name in ranked)], rows, caption=f"{_value(task)}; {task.ranking_shot}-shot")


def _estimates(board: Board, names: Sequence[str]) -> dict[str, ByView]:
    """What the first ranked methods say of the stiffness, by object and view: of each its name and, a row a point,
    place, truth and estimate (k, 5)."""
    out: dict[str, ByView] = {}
    having = [(row, name) for row, name in zip(board.rows, names, strict=True) if row.rank and row.result.maps]
    for row, label in having[:MOST_LINES]:
        columns = row.result.maps
        views = np.array(columns["object"])
        values = np.array([columns[key] for key in ("x", "y", "z", "truth", "mean")], float).T
        for view in dict.fromkeys(columns["object"]):
            out.setdefault(object_of(view), {}).setdefault(view, []).append((label, values[views == view]))
    return out


def _maps(estimates: ByView) -> list[str]:
    """The truth and the estimates of an object, view by view."""
    out: list[str] = []
    for view, found in sorted(estimates.items()):
        truth = found[0][1]
        places, true = MAP_STEP * (truth[:, :3] - MAP_ORIGIN), truth[:, 3]
        if not (true > 0.0).any():
            continue
        low, high = (float(np.quantile(true[true > 0.0], q)) for q in (0.02, 0.98))
        high = max(high, 1.01 * low)
        pictures = [charts.stiffness_map(places, true, low=low, high=high, name="truth")]
        for label, array in found:
            known = true > 0.0
            if len(array) == len(truth) and (array[known, 4] > 0.0).any():
                estimate = array[:, 4] / 10.0 ** scale_of(array[known, 4], true[known])
                pictures.append(charts.stiffness_map(places, estimate, low=low, high=high, name=label))
        out.append('<div class="pair">' + "".join(f"<figure>{p}</figure>" for p in pictures) + "</div>")
        out.append(figure(charts.scale_bar(low, high, "N/m"), f"Stiffness on {view}."))
    return out


def _picture(task: Task, name: str) -> str:
    """The photograph of an object, from the task's dataset; a sentence where that is not here."""
    try:
        dataset = Dataset.open(task.dataset.path()).blind()
        view = next(entry.name for entry in dataset.entries if object_of(entry.name) == name)
        return figure(charts.png(dataset.picture(view), name), f"What the camera sees of {view}.")
    except (DatasetError, StopIteration, OSError):
        return paragraph(f"Its picture is in the dataset, which is not on this machine; `{task.dataset.command()}` "
                         f"makes it.", note=True)
