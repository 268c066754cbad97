"""Answers beside the truth, which is read here, after the method has answered: the result with its rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vsfsim.bench.metrics import Answer, can_be_scored, record_scores, scores_of, touch_errors
from vsfsim.bench.protocol import Answers, Recording, Subject
from vsfsim.bench.result import Result, machine, versions
from vsfsim.bench.result_file import (
    MAP_COLUMNS,
    MAP_ORIGIN,
    MAP_STEP,
    READING_COLUMNS,
    Rows,
    as_columns,
    beside_zero,
    stored,
)
from vsfsim.bench.task import Task
from vsfsim.data.dataset import Dataset
from vsfsim.data.provenance import made_by


def result_of(answers: Sequence[Answers], task: Task, dataset: Dataset, seeds: tuple[int, ...], **said: Any) -> Result:
    """The result of all answers to a task; the truth is read here, after the method has answered.

    Args:
        answers: of every object, shot and run. task, dataset: of the questions. seeds: numbers of the runs. said:
        further fields of `Result`, at least ``method`` and ``entry``.
    """
    rows: Rows = {answer: [] for answer in Answer}
    readings, maps = dict[str, list](), dict[str, list]()
    for name in dict.fromkeys(a.trial.subject for a in answers):
        _add(name, [a for a in answers if a.trial.subject == name], task, dataset, rows, readings, maps)
    if task.protocol.folds:
        stored(rows[Answer.READINGS])
    asked = {**rows, Answer.READINGS: beside_zero(rows[Answer.READINGS], readings)}
    scores = {metric: by_shot for answer in Answer
              for metric, by_shot in scores_of(answer, asked[answer], task.protocol.labels, seeds).items()}
    fields: dict[str, Any] = {"parameters": {}, "timing": {}, "peak_memory_mib": 0.0, "versions": versions(), **said}
    return Result(
        task=task.name, task_sha256=task.sha256, dataset_sha256=dataset.sha256, dataset_made_by=dict(dataset.made_by),
        observation=task.observation.name, unit=task.observation.unit, shots=task.protocol.labels, seeds=seeds,
        scores=scores, queries=as_columns(Answer.READINGS, rows[Answer.READINGS]), readings=readings,
        machine=machine(), made_by=made_by(), maps={} if fields.get("study") else maps,
        answers={answer.value: as_columns(answer, rows[answer]) for answer in Answer
                 if answer is not Answer.READINGS and rows[answer]}, **fields)


def _add(name: str, answers: Iterable[Answers], task: Task, dataset: Dataset, rows: Rows, readings: dict[str, list],
         maps: dict[str, list]) -> None:
    """Add the rows of one test object, the summary of its query readings (`Result.readings`), and its `Result.maps`.

    Of a task with cross-validation, maps are the stiffness that the method gave beside the truth, in the first run at
    the shot that ranks and for the first view of each object, because all of them would be most of a result file.

    Args:
        name: of the object view. answers: of its trials. task, dataset: of the evaluation.
    """
    view = dataset.load(name)
    assert view.truth is not None
    subject = Subject.of(view, view.truth.probe_points, task, dataset)
    known, columns, inclusions = view.truth.probe_stiffness[subject.near], subject.columns, subject.inclusions
    usable = known > 0.0  # ratios are scored; a cone that met nothing has none
    mapped = (task.ranking_shot, 0) if task.protocol.folds and view.view_index == 0 else None

    def keep(answer: Answer, given: Answers, values: Mapping[str, Any]) -> None:
        rows[answer].append({"object": name, "shot": given.trial.shot, "seed": given.trial.seed, **values})

    for given in answers:
        for k, index in enumerate(subject.draw.query):
            clean, valid = subject.recording.queries[index].clean, subject.recording.queries[index].scored
            keep(Answer.READINGS, given, {"touch": index, **touch_errors(given.readings[k], clean, valid)})
        if given.mean is not None and can_be_scored(given.mean[usable], known[usable]):
            stiffness = {"mean": given.mean[usable], "truth": known[usable]}
            keep(Answer.STIFFNESS, given, record_scores(Answer.STIFFNESS, [stiffness]))
        if given.mean is not None and (given.trial.shot, given.trial.seed) == mapped:
            _extend(maps, _map_of(name, subject.points, known, given.mean))
        if given.column_mean is not None and columns is not None and inclusions is not None:
            values = {"value": columns.largest(given.column_mean), "stiff": columns.covers(inclusions)}
            keep(Answer.MASK, given, record_scores(Answer.MASK, [values]))
        if given.pose is not None and inclusions is not None:
            poses = {"estimate": given.pose, "truth": inclusions.known_object()[2]}
            keep(Answer.POSE, given, record_scores(Answer.POSE, [poses]))
    _extend(readings, readings_of(subject.recording, subject.draw.query))


def _extend(columns: dict[str, list], more: Mapping[str, list]) -> None:
    for column, values in more.items():
        columns.setdefault(column, []).extend(values)


def _map_of(name: str, places: np.ndarray, truth: np.ndarray, mean: np.ndarray) -> dict[str, list]:
    """Columns of `Result.maps`, with three digits of each number."""
    steps = np.clip(np.rint(places / MAP_STEP).astype(int) + MAP_ORIGIN, 0, 2 * MAP_ORIGIN)
    numbers = [[float(np.float32(f"{v:.3g}")) for v in values] for values in (truth, mean)]
    return dict(zip(MAP_COLUMNS, [[name] * len(steps), *steps.T.tolist(), *numbers], strict=True))


def readings_of(recording: Recording, query: Iterable[int]) -> dict[str, list]:
    """`Result.readings` of the query touches of a recording."""
    rows = [(recording.name, int(index), int(values.size), float(np.sum(values**2))) for index, values in (
        (index, recording.queries[index].clean[recording.queries[index].scored]) for index in query)]
    return {name: [row[k] for row in rows] for k, name in enumerate(READING_COLUMNS)}
