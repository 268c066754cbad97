"""Answers beside the truth: the rows of a result file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vsfsim.bench.inclusions import Inclusions, Mask
from vsfsim.bench.metrics import Answer, record_scores
from vsfsim.bench.protocol import Recording, divide, record
from vsfsim.bench.reading_metrics import touch_errors, touch_uncertainty
from vsfsim.bench.stiffness_metrics import can_be_scored
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Answers
from vsfsim.bench.trials.rows import MAP_COLUMNS, MAP_ORIGIN, MAP_STEP, READING_COLUMNS, Rows
from vsfsim.bench.trials.subject import touched
from vsfsim.data.dataset import Dataset


def rows_of(name: str, answers: Iterable[Answers], task: Task, dataset: Dataset) -> tuple[Rows, Mapping[str, list]]:
    """The rows of one test object, and the summary of its query readings (`Result.readings`).

    The truth is read here, after the method has answered.

    Args:
        name: of the object view. answers: of its trials. task, dataset: of the evaluation.
    """
    view = dataset.load(name)
    assert view.truth is not None
    draw, recording, ranked = divide(view, task.protocol), record(view, task), task.metric.answer
    known = view.truth.probe_stiffness[touched(view.truth.probe_points, view)]
    usable = known > 0.0  # ratios are scored; a cone that met nothing has none
    inclusions = Inclusions.of(dataset.recipe, view) if ranked in (Answer.MASK, Answer.POSE) else None
    mask = Mask.of(inclusions, view) if inclusions is not None and ranked is Answer.MASK else None
    rows: Rows = {answer: [] for answer in Answer}

    def keep(answer: Answer, given: Answers, values: Mapping[str, Any]) -> None:
        rows[answer].append({"object": name, "shot": given.trial.shot, "seed": given.trial.seed, **values})

    for given in answers:
        for k, index in enumerate(draw.query):
            clean, valid = recording.queries[index].clean, recording.queries[index].scored
            keep(Answer.READINGS, given, {"touch": index, **touch_errors(given.readings[k], clean, valid)})
            if given.readings_std is not None:
                keep(Answer.READING_STD, given, {
                    "touch": index, **touch_uncertainty(given.readings[k], given.readings_std[k], clean, valid)})
        if given.mean is not None and can_be_scored(given.mean[usable], known[usable]):
            stiffness = {"mean": given.mean[usable], "truth": known[usable],
                         "std": None if given.std is None else given.std[usable]}
            keep(Answer.STIFFNESS, given, record_scores(Answer.STIFFNESS, [stiffness]))
        if given.column_mean is not None and mask is not None:
            values = {"value": mask.pixel_values(given.column_mean), "stiff": mask.stiff}
            keep(Answer.MASK, given, record_scores(Answer.MASK, [values]))
        if given.pose is not None and inclusions is not None and ranked is Answer.POSE:
            poses = {"estimate": given.pose, "truth": inclusions.known_object()[2]}
            keep(Answer.POSE, given, record_scores(Answer.POSE, [poses]))
    return rows, readings_of([(recording, draw.query)])


def map_of(given: Answers, dataset: Dataset) -> dict[str, list]:
    """The stiffness that a method gave in one trial beside the truth, rows of `vsfsim.bench.result.Result.maps`; three
    digits of each number. Empty where it gave none."""
    view = dataset.load(given.trial.subject)
    assert view.truth is not None
    if given.mean is None:
        return {name: [] for name in MAP_COLUMNS}
    near = touched(view.truth.probe_points, view)
    std = np.zeros(len(given.mean)) if given.std is None else given.std
    steps = np.clip(np.rint(view.truth.probe_points[near] / MAP_STEP).astype(int) + MAP_ORIGIN, 0, 2 * MAP_ORIGIN)
    numbers = [[float(np.float32(f"{v:.3g}")) for v in values] for values in (view.truth.probe_stiffness[near],
                                                                              given.mean, std)]
    return dict(zip(MAP_COLUMNS, [[view.name] * len(steps), *steps.T.tolist(), *numbers], strict=True))


def readings_of(asked: Iterable[tuple[Recording, Iterable[int]]]) -> dict[str, list]:
    """`Result.readings` of recordings and their query touches."""
    rows = [(recording.name, index, recording.queries[index].clean[recording.queries[index].scored])
            for recording, query in asked for index in query]
    columns = ([name for name, _, _ in rows], [int(index) for _, index, _ in rows], [int(v.size) for _, _, v in rows],
               [float(np.sum(v**2)) for _, _, v in rows])
    return dict(zip(READING_COLUMNS, columns, strict=True))
