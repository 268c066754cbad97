"""Scoring a file of predictions, for methods that run elsewhere (another language, another machine).

The file is an .npz with one array (T, d) for every query: its key is ``<object>/<shot>/<seed>/<touch>``, e.g.
``shoe-0004-v0/5/0/011``. `questions` lists them together with the touches that may be used for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from vsfsim.bench.evaluate import readings_of, scores_of
from vsfsim.bench.method import Action, Reading, checked_prediction, frozen_view
from vsfsim.bench.metrics import Answer
from vsfsim.bench.protocol import divide, record, support
from vsfsim.bench.reading_metrics import touch_errors
from vsfsim.bench.result import QUERY_COLUMNS, Result, machine, peak_memory_mib, versions
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError
from vsfsim.data.dataset import Dataset
from vsfsim.data.provenance import made_by
from vsfsim.data.records import View


@dataclass(frozen=True)
class Question:
    """One adaptation that the task asks for."""

    name: str
    """Of the object view."""
    shot: str
    """Label of the shot."""
    seed: int
    """Of the support draw."""
    view: View
    """Of the object."""
    support: tuple[Reading, ...]
    """Touches that the method may learn from."""
    touches: tuple[int, ...]
    """Indices of the query touches."""
    actions: tuple[Action, ...]
    """Of the query touches."""
    keys: tuple[str, ...]
    """Names of the answers in the file, one a query touch."""


def questions(task: Task, dataset: Dataset) -> Iterator[Question]:
    """All adaptations that the task asks for, in order, without a reading of a query touch."""
    for view in map(dataset.blind().load, dataset.names(task.protocol.test)):
        readings, draw, shown = record(view, task).readings, divide(view, task.protocol), frozen_view(view.view)
        for seed in range(task.protocol.seeds):
            for label in task.protocol.labels:
                chosen = support(view, draw, label, seed, task.protocol)
                yield Question(view.name, label, seed, shown, tuple(readings[i] for i in chosen), draw.query,
                               tuple(readings[i].action for i in draw.query),
                               tuple(f"{view.name}/{label}/{seed}/{i:03d}" for i in draw.query))


def score_predictions(path: str | Path, task: Task, dataset: Dataset, *, name: str) -> Result:
    """Score the predictions in ``path``; ``name`` is what the method is called in the result.

    Raises:
        MethodError: the file is not an .npz, a key is missing or unknown, or a prediction has the wrong shape or is not
            finite.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            given = {key: file[key] for key in file.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise MethodError(f"predictions {path} cannot be read: {error}. Give an .npz as "
                          f"numpy.savez writes it.") from error
    clean = {view.name: record(view, task) for view in map(dataset.blind().load, dataset.names(task.protocol.test))}
    rows, asked, queries = [], set(), {}
    for question in questions(task, dataset):
        queries[question.name] = question.touches
        for key, touch, action in zip(question.keys, question.touches, question.actions):
            if key not in given:
                raise MethodError(f"predictions {path} have no '{key}'. One array (T, d) a query is needed; "
                                  f"`vsfsim.bench.predictions.questions` lists the keys.")
            prediction = checked_prediction([given[key]], [action], [key])[0]
            recording = clean[question.name]
            errors = touch_errors(prediction, recording.clean[touch], recording.readings[touch].valid)
            rows.append({"object": question.name, "shot": question.shot, "seed": question.seed, "touch": touch,
                         **errors})
            asked.add(key)
    for key in given:
        if key not in asked:
            raise MethodError(f"predictions {path} have '{key}', which the task does not ask. Keys are "
                              f"<object>/<shot>/<seed>/<touch>.")
    seeds = tuple(range(task.protocol.seeds))
    return Result(
        task=task.name, task_sha256=task.sha256, dataset_sha256=dataset.sha256, dataset_made_by=dict(dataset.made_by),
        method=name, entry="predictions file", parameters={}, observation=task.observation.name,
        unit=task.observation.unit, shots=task.protocol.labels, seeds=seeds,
        scores=scores_of(Answer.READINGS, rows, task.protocol.labels, seeds),
        queries={column: [row[column] for row in rows] for column in QUERY_COLUMNS}, timing={},
        peak_memory_mib=round(peak_memory_mib(), 1), machine=machine(), made_by=made_by(), versions=versions(),
        notes=("scored from a file of predictions",),
        readings=readings_of((clean[name], touches) for name, touches in queries.items()))
