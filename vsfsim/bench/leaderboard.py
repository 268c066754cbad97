"""A task's table of methods, from the result files."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.bench.admission.admit import admit
from vsfsim.bench.admission.fingerprint import shipped_record
from vsfsim.bench.board.compare import TOLD_APART, ByObject, by_object, interval, joined_ranks
from vsfsim.bench.board.named import (
    CEILING,
    CLAIMED,
    EARLIER,
    LIST,
    Entry,
    absent,
    claimed,
    command_of,
    contradicts,
    far_apart,
    is_ceiling,
    is_same,
    listed,
    row_sha256,
    write_list,
)
from vsfsim.bench.board.shipped import Shipped, read_rows, write_rows
from vsfsim.bench.metrics import METRICS, Answer, Score
from vsfsim.bench.result import Result, machine
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import markdown as escaped
from vsfsim.core.plain_text import plain
from vsfsim.core.shelf import folder
from vsfsim.core.text_table import text_table
from vsfsim.data.provenance import made_by


@dataclass(frozen=True)
class Row:
    """One method."""

    rank: int | None
    """From 1; None where the result may not be ranked."""
    mark: str
    """Why it is not ranked, or ""."""
    result: Result
    """The result."""
    scores: Mapping[str, Mapping[str, Score]]
    """Its scores by metric and shot, computed from its rows."""
    path: Path
    """Its file."""
    other_bits: bool
    """Its dataset is the board's, made on a machine that rounds otherwise."""
    objects: Mapping[str, ByObject] = dataclasses.field(default_factory=dict)
    """Of a task with cross-validation, the value of its metric of each object, by shot."""
    origin: str = "shipped"
    """"shipped", "made here", or "shipped, made again here"."""
    evidence: str = "open"
    """What the repository's list says that it rests on (`vsfsim.bench.board.named.Entry`)."""

    @property
    def signs(self) -> str:
        """Behind the name: † an earlier row, * not ranked for another reason, ~ other bits."""
        return " †" if self.mark == EARLIER else " *" if self.mark else " ~" if self.other_bits else ""


@dataclass(frozen=True)
class Board:
    """A task's rows, the ranked ones first and best first."""

    task: Task
    """The task."""
    dataset_sha256: str
    """Of the dataset that the ranked results were scored on."""
    has_record: bool
    """The task ships a record of its dataset, with which the results are compared; else with one another."""
    again: float
    """Share of the dataset's touches that came to another end on another machine [-]
    (`vsfsim.bench.admission.admit`)."""
    rows: tuple[Row, ...]
    """One row a result."""
    unresolved: tuple[int, int, float] | None = None
    """Of its query touches (`vsfsim.bench.protocol.share_unresolved`); None where it was not measured."""


def collect(task: Task, paths: Iterable[Path] = ()) -> Board:
    """Rank the results of ``task``: those shipped in leaderboard/<task>/ and those in ``paths`` (files, or folders of
    them).

    Scores are computed again from the rows of a result (`vsfsim.bench.admission.admit`). One that may not be ranked is
    shown with the reason. The board's dataset is that of the task's record; without one, it is the one that the task
    names, else that of most shipped results (of most results, if none ships), and one with other bits is the same if
    its readings are (`SAME_READINGS`). Equal results are one row.

    Raises:
        TaskError: a file is not a result, or is a result of another task.
    """
    board = folder("leaderboard") / f"{task.name}.json"
    packed = [(board / one.name, one) for one in read_rows(board)]
    shipped = sorted((folder("leaderboard") / task.name).glob("*.json"))
    files = list(shipped)
    for path in paths:
        if not path.exists():
            raise TaskError(f"{path} does not exist; give result files of `vsfsim evaluate --out`, or folders of them.")
        files += sorted(path.glob("*.json")) if path.is_dir() else [path]
    results = [(path, Result.load(path)) for path in dict.fromkeys(files)]
    told = [(path, one.result) for path, one in packed] + results
    for path, result in told:
        if result.task != task.name:
            raise TaskError(f"{path} is a result of task {result.task}, not of {task.name}.")
    record = shipped_record(task)
    reference = record.dataset_sha256 if record is not None else task.dataset.sha256 or _most(
        [r for path, r in told if path in shipped or r.values], task) or _most([r for _, r in results], task)
    known = next((r.readings for _, r in told if r.dataset_sha256 == reference and r.readings), {})
    good: list[Row] = []
    odd: list[Row] = []
    kept, entries, shot = dict(packed), listed(), task.ranking_shot
    for path, result in told:
        entry, here = None, path not in kept and path not in shipped
        if path in kept:  # looked at when it was packed
            scores, mark, other = result.scores, kept[path].mark, kept[path].other_bits
            entry = entries.get(row_sha256(result))
            if result.task_sha256 != task.sha256:
                mark = "other text of the task"
            elif entry is None:
                mark = EARLIER
        else:
            admission = admit(result, task, record)
            scores, other = admission.scores, result.dataset_sha256 != reference
            entry = None if here else entries.get(row_sha256(dataclasses.replace(result, scores=scores)))
            mark = admission.reason or (far_apart(result, known) if other and record is None else "") or (
                CLAIMED if entry is None and claimed(result, task) else CEILING if is_ceiling(result) else "")
        # a shipped result that was made again here, to the same numbers, is one row
        rows = odd if mark else good
        if not mark:  # an earlier row that comes out again needs no row of its own
            odd = [row for row in odd if row.mark != EARLIER or not is_same(result, row.result)]
        same = next((k for k, before in enumerate(rows) if is_same(result, before.result)), None)
        if same is None:
            objects = {shot: by_object(result, task.primary, shot) for shot in result.shots
                       } if task.protocol.folds and mark in ("", CEILING, EARLIER) else {}
            row = Row(None, mark, result, scores, path, other and not mark, objects, "made here" if here else "shipped",
                      "open" if entry is None else entry.evidence)
            if entry is None and not mark and any(
                    one.origin != "made here" and contradicts(result, one.result, task, (
                        row.objects.get(shot, {}), one.objects.get(shot, {}))) for one in good):
                row, rows = dataclasses.replace(row, mark=CLAIMED, other_bits=False), odd
            rows.append(row)
        elif here and rows[same].origin == "shipped":
            rows[same] = dataclasses.replace(rows[same], origin="shipped, made again here")
    sign = -1.0 if task.metric.higher_is_better else 1.0
    good.sort(key=lambda row: (sign * row.scores[task.primary][task.ranking_shot].mean, row.result.method))
    ranks = joined_ranks([row.objects[task.ranking_shot] for row in good]) if task.protocol.folds else range(
        1, len(good) + 1)
    ranked = [dataclasses.replace(row, rank=rank) for rank, row in zip(ranks, good, strict=True)]
    again = record.again.touches if record is not None and record.again is not None else 0.0
    return Board(task, reference, record is not None, again, (*ranked, *odd), record.unresolved if record else None)


def _most(results: list[Result], task: Task) -> str:
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


def ship(board: Board, path: Path) -> None:
    """Write a board as the file that ships, `leaderboard/TASK.json`, and its rows into the list beside it. A row that
    was made again here, to the same numbers, becomes "verified".

    Raises:
        TaskError: a file cannot be written.
    """
    rows = [dataclasses.replace(row.result, scores=row.scores) for row in board.rows]
    write_rows([Shipped(row.path.name, result, "" if row.mark == EARLIER else row.mark, row.other_bits)
                for row, result in zip(board.rows, rows, strict=True)], path)
    entries = listed()
    for row, result in zip(board.rows, rows, strict=True):
        again, sha256 = row.origin == "shipped, made again here", row_sha256(result)
        if again or (row.origin == "made here" and row.mark in ("", CEILING)):
            entries[sha256] = Entry(sha256, board.task.name, result.method, "verified" if again else "open",
                                    command_of(result), str((made_by() if again else result.made_by).get("commit")),
                                    str((machine() if again else result.machine).get("cpu")))
    write_list(entries.values(), path.parent / LIST)


def table(board: Board) -> dict[str, Any]:
    """The board for JSON."""
    task = board.task
    ceiling = possible(board)
    rows = [{"rank": row.rank, "share_of_possible": {shot: share_of_possible(row, ceiling, shot) for shot in ceiling},
             "method": row.result.method, "parameters": dict(row.result.parameters),
             "origin": row.origin, "evidence": row.evidence, "file": str(row.path),
             "not_ranked_because": row.mark, "objects": {shot: dict(values) for shot, values in row.objects.items()},
             "scores": {metric: {shot: {"mean": score.mean, "std": score.std} for shot, score in by_shot.items()}
                        for metric, by_shot in row.scores.items()},
             "timing": dict(row.result.timing), "made_by": dict(row.result.made_by)} for row in board.rows]
    return {"task": task.name, "metric": task.primary, "unit": unit_of(task.primary, task.observation.unit),
            "ranking_shot": task.ranking_shot, "higher_is_better": task.metric.higher_is_better,
            "dataset_sha256": board.dataset_sha256, "rows": rows}


def text(board: Board) -> str:
    """The board for a terminal; its last column says which results shipped and which were made here."""
    head, rows = cells(board)
    head, rows = [*head, "result"], [[*cells, row.origin] for cells, row in zip(rows, board.rows, strict=True)]
    lines = [_title(board), "", text_table(head, rows)]
    lines += footnotes(board)
    paper = published(board)
    if paper:
        lines += ["", "From the literature (not comparable: other data or another quantity, see the unit):",
                  text_table(paper[0], paper[1:])]
    return "\n".join(lines)


def markdown(board: Board) -> str:
    """The board as a page."""
    head, rows = cells(board, escaped)
    lines = [f"# {board.task.name}", "", board.task.description, "", _title(board), "", *_piped([head, *rows])]
    lines += ["", *footnotes(board, escaped)]
    paper = published(board)
    if paper:
        lines += ["", "From the literature, as context only (not comparable: other data or another quantity, "
                      "see the unit):", "", *_piped(paper)]
    return "\n".join(lines).rstrip() + "\n"


def score_table(result: Result, metric: str) -> str:
    """One result for a terminal: every metric by shot."""
    head, rows = score_cells(result, result.scores, metric)
    return text_table([result.method, *head[1:]], rows)


def score_cells(result: Result, scores: Mapping[str, Mapping[str, Score]], metric: str
                ) -> tuple[list[str], list[list[str]]]:
    """Head and rows of a table of every metric by shot, that called ``metric`` first."""
    # a method without the function that the task ranks by has no such row
    order = [*(m for m in (metric,) if m in scores), *(m for m in scores if m != metric)]
    units = {name: unit_of(name, result.unit) for name in order}
    return ["metric", *(f"{label}-shot" for label in result.shots)], [
        [f"{name} [{unit}]" if unit else name, *(score_text(scores[name].get(label)) for label in result.shots)]
        for name, unit in units.items()]


def unit_of(metric: str, of_reading: str) -> str:
    """Of a metric, "" for a pure number and for one that this version does not know."""
    unit = METRICS[metric].unit if metric in METRICS else ""
    return of_reading if unit is None else unit


def _title(board: Board) -> str:
    task = board.task
    unit = unit_of(task.primary, task.observation.unit) or "-"
    what = f"{'of' if task.metric.answer is Answer.READINGS else 'from'} {task.observation.name}"
    better = "higher" if task.metric.higher_is_better else "lower"
    spread = "standard error over objects" if task.protocol.folds else "std over seeds"
    return (f"{task.primary} {what} [{unit}], mean ± {spread}, {better} is better; ranked at "
            f"{task.ranking_shot}-shot")


def cells(board: Board, shown: Callable[[str], str] = plain) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table of a board; ``shown`` is what becomes of names."""
    task = board.task
    labels = task.protocol.labels
    ceiling = possible(board)
    head = ["#", "method", *(f"{label}-shot" for label in labels), *(["of possible"] if ceiling else []), "rank corr.",
            "evidence", "adapt", "sandbox", "vsfsim"]
    rows, names = [], labels_of(board.rows)
    for row, label in zip(board.rows, names):
        by_shot = row.scores.get(task.primary, {})
        stiffness = row.scores.get("stiffness_spearman", {}).get(task.ranking_shot)
        adapt = row.result.timing.get("adapt_s", 0.0) / max(row.result.timing.get("adapts", 0), 1)
        commit = str(row.result.made_by.get("commit") or "")[:7]
        made_by = f"{row.result.made_by.get('vsfsim')} {commit}".strip()
        share = share_of_possible(row, ceiling, task.ranking_shot)
        values = [interval_text(row.objects[shot]) if row.objects and task.protocol.folds else
                  score_text(by_shot.get(shot)) for shot in labels]
        rows.append([str(row.rank or "-"), shown(label) + row.signs, *values,
                     *(["" if share is None else f"{share:.2f}"] if ceiling else []),
                     score_text(stiffness), row.evidence, f"{adapt:.2f} s",
                     shown(row.result.isolation or "-"), shown(made_by)])
    return head, rows


def possible(board: Board) -> dict[str, float]:
    """By shot, the mean ratio of the lowest ceiling that ran at the data's own tier; {} where the board has none, or
    does not rank by the error over that of predicting zero."""
    found = [row.scores["rmse_ratio"] for row in board.rows if row.mark == CEILING
             and board.task.primary == "rmse_ratio" and not row.result.parameters.get("tier")]
    return {shot: min(one[shot].mean for one in found if shot in one) for shot in found[0]} if found else {}


def share_of_possible(row: Row, ceiling: Mapping[str, float], shot: str) -> float | None:
    """(1 - e) / (1 - ceiling) of a row's mean ratio e at a shot [-]: 0 predicts zero, 1 is the true object."""
    score = row.scores.get("rmse_ratio", {}).get(shot)
    return None if score is None or shot not in ceiling else (1.0 - score.mean) / (1.0 - ceiling[shot])


def footnotes(board: Board, shown: Callable[[str], str] = plain) -> list[str]:
    """What its columns and signs say, and which rows are not ranked or absent; operands as of `cells`."""
    task, rows, marks = board.task, board.rows, {row.mark for row in board.rows}
    lines = list(dict.fromkeys(f"* {shown(row.result.method)}: {shown(row.mark)}, not ranked" for row in rows
                               if row.mark not in ("", EARLIER)))
    if task.superseded_by:
        lines.append(f"superseded by {task.superseded_by}: the rows that ship were made on data of an earlier vsfsim, "
                     f"and compare with one another only; a dataset made today may differ")
    if task.protocol.folds and rows:
        lines.append(f"methods share a rank if their paired difference over objects is below {TOLD_APART:g} standard "
                     f"errors")
    if possible(board):
        lines.append(f"of possible: (1 - e) / (1 - ceiling) of the mean error e at {task.ranking_shot}-shot; 0 "
                     f"predicts zero, 1 is the true object asked again")
    if rows:
        lines.append("evidence, by the list of the repository (leaderboard/evidence.json): open, made once; sealed, "
                     "scored on readings that only the maintainers have; verified, made again by them to the same "
                     "numbers")
    if any(row.other_bits for row in rows):
        lines.append("~ on the same dataset, made on a machine that rounds otherwise" + (
            f"; rounding decides where {100.0 * board.again:.0f} % of its touches end" if board.again else ""))
    verdict = "are scored" if task.protocol.unresolved == "scored" else "are left out"
    if board.unresolved is None:
        lines.append(f"frames whose contact the mesh does not resolve {verdict}; their share was not measured")
    else:
        frames, odd, share = board.unresolved
        lines.append(f"{odd} of {frames} contact frames of the query touches ({odd / max(frames, 1):.0%}) are not "
                     f"resolved by the mesh; they carry {share:.0%} of the squared force and {verdict}")
    if EARLIER in marks:
        lines.append(f"† {EARLIER}; not ranked, and no claim rests on it")
    lines += [f"no row of {names}: {reason}" for names, reason in absent(task.name).items()]
    if rows and not board.has_record:
        lines.append("this task ships no record of its dataset; only query readings were compared, with one another")
    if not rows:
        lines.append(f"no results yet; `vsfsim evaluate --method NAME --task {task.name} --out FILE` makes one")
    elif any("stiffness_spearman" in row.scores for row in rows):
        lines.append(f"rank corr.: Spearman's, of the stiffness estimate at {task.ranking_shot}-shot with the "
                     f"true probe stiffness where touched")
    return lines


def published(board: Board) -> list[list[str]]:
    """Head and rows of the literature, [] without any. In brackets stands the ratio to the 0-shot error of the paper's
    zero Gaussian prior, which predicts zero."""
    labels = board.task.protocol.labels
    zero = {row.unit: _mean(row.values["0"]) for row in board.task.paper
            if "(zero)" in row.method and "0" in row.values}
    rows = [[row.method, *(_pair(row.values.get(label), zero.get(row.unit)) for label in labels), row.unit,
             row.source + ("" if row.comparable else " (not comparable)")]
            for row in board.task.paper]
    return [["method", *(f"{label}-shot" for label in labels), "unit", "source"], *rows] if rows else []


def score_text(score: Score | None) -> str:
    """A score with its deviation over runs, "" for none."""
    return "" if score is None else f"{score.mean:.3f} ± {score.std:.3f}"


def interval_text(values: ByObject) -> str:
    """A mean over objects with its standard error."""
    mean, error = interval(values)
    return f"{mean:.3f} ± {error:.3f}" if error == error else f"{mean:.3f}"


def _pair(value: float | tuple[float, float] | None, zero: float | None) -> str:
    if value is None:
        return ""
    mean, *std = value if isinstance(value, tuple) else (value,)
    return " ± ".join(f"{v:.2f}" for v in (mean, *std)) + ("" if zero is None else f" ({mean / zero:.2f})")


def _mean(value: float | tuple[float, float]) -> float:
    return value[0] if isinstance(value, tuple) else value


def _piped(rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return [lines[0], "|" + "---|" * len(rows[0]), *lines[1:]]
