"""Errors of the continuous fields with several settings, on objects of another seed: `vsfsim measure field-settings`.

A field learns nothing from other objects, so that its settings can be chosen on any objects that a task does not ask:
some touches of each object are predicted from five others, and from all others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.bench.board.compare import interval
from vsfsim.bench.commands.presets import on_device, preset
from vsfsim.bench.method import build_method, find_method, parameters_of
from vsfsim.bench.metric_functions import rmse_ratio, touch_errors
from vsfsim.bench.protocol import Recording, record
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError
from vsfsim.data.dataset import Dataset

VARIANTS: Mapping[str, tuple[str, str, Mapping[str, Any]]] = {
    "neural-vsf, forces on vertices": ("neural-vsf", "tuned", {"skin": True, "octaves": 4}),
    "neural-vsf (paper), forces on vertices": ("neural-vsf", "paper", {"skin": True}),
    "neural-vsf, pressure, 1 octave": ("neural-vsf", "tuned", {"skin": False, "octaves": 1}),
    "neural-vsf, pressure, 2 octaves": ("neural-vsf", "tuned", {"skin": False, "octaves": 2}),
    "neural-vsf, pressure, 4 octaves": ("neural-vsf", "tuned", {"skin": False, "octaves": 4}),
    "neural-vsf, pressure, 2 octaves, 1,000 steps": ("neural-vsf", "tuned",
                                                     {"skin": False, "octaves": 2, "iterations": 1000}),
    "neural-vsf (paper), pressure": ("neural-vsf", "paper", {"skin": False}),
    "grid-vsf, forces on vertices": ("grid-vsf", "tuned", {"skin": True}),
    "grid-vsf, pressure": ("grid-vsf", "tuned", {"skin": False}),
    "grid-vsf, pressure, cells of 8 mm": ("grid-vsf", "tuned", {"skin": False, "cell": 0.008, "iterations": 500,
                                                                "batch": 4000, "samples": 8, "rate": 0.3}),
}
"""Method, preset and what is set over it, by what is printed; "pressure" is the reading of a frame."""
FEW = 5  # touches


def measure(task: Task, dataset: Dataset, *, variants: Sequence[str] = tuple(VARIANTS), query: int = 8,
            trainings: int = 2, device: str = "cpu", progress: Progress = lambda _: None) -> Measurement:
    """Error over that of predicting zero (`rmse_ratio`) of each variant on each object view, mean over trainings.

    Args:
        task: what a reading is and its noise.
        dataset: objects that the task does not ask.
        variants: of `VARIANTS`.
        query: touches of each object that are predicted, drawn at random; the others may be fitted.
        trainings: of each field, with seeds 0, 1, ...
        device: torch device of `neural-vsf`.
        progress: called with what is going on.

    Raises:
        MethodError: the dataset has the task's own objects, or a view has too few touches or reads nothing in those
            that are predicted.
    """
    own, found = task.dataset, dataset.recipe
    if (found.scene, found.seed) == (own.scene, own.seed):
        raise MethodError(f"measure field-settings: {dataset.path} has objects of {task.name} itself (scene "
                          f"'{found.scene}', seed {found.seed}), on which no setting may be chosen. Make others: "
                          f"`vsfsim generate {own.scene} --seed {own.seed + 1} --out FOLDER`.")
    errors: dict[str, tuple[dict[str, float], dict[str, float]]] = {name: ({}, {}) for name in variants}
    for name in dataset.names():
        view = dataset.load(name)
        recording = record(view, task)
        if len(recording.readings) < query + FEW:
            raise MethodError(f"measure field-settings: {name} has {len(recording.readings)} touches; {query} to "
                              f"predict and {FEW} to fit need {query + FEW}.")
        order = np.random.default_rng(0).permutation(len(recording.readings))
        asked, pool = order[:query], order[query:]
        for variant, (few, every) in errors.items():
            progress(f"{name}: {variant}")
            for support, out in ((pool[:FEW], few), (pool, every)):
                out[name] = float(np.mean([_ratio(_method(task, variant, seed, device), view.view, recording, support,
                                                  asked) for seed in range(trainings)]))
    rows = [{"name": name, "few": _mean(few), "all": _mean(every)} for name, (few, every) in errors.items()]
    columns = (Column("name", "settings"), Column("few.mean", f"{FEW} touches", "1", form=".3f"),
               Column("few.error", "±", "1", form=".3f"), Column("all.mean", "all others", "1", form=".3f"),
               Column("all.error", "±", "1", form=".3f"))
    settings = {"task": task.name, "dataset": str(dataset.path), "query": query, "trainings": trainings,
                "device": device}
    title = f"Error of {task.observation.name} over that of predicting zero, {len(dataset.names())} object views"
    return Measurement.of("field-settings", settings, [Table(title, columns, rows, "settings")])


def _method(task: Task, name: str, seed: int, device: str):
    method, of, given = VARIANTS[name]
    observation = task.observation.name
    chosen = on_device(preset(method, of, observation), "" if device == "cpu" else device, observation)
    found = find_method(method)
    return build_method(found, parameters_of(found, {**chosen.parameters, **given, "seed": seed}))


def _ratio(method, view, recording: Recording, support: Sequence[int], asked: Sequence[int]) -> float:
    method.adapt(view, [recording.readings[i] for i in support])
    queries = [recording.queries[i] for i in asked if recording.queries[i].scored.any()]
    sums = [{**touch_errors(answer, query.clean, query.scored), "ss": float(np.sum(query.clean[query.scored] ** 2)),
             "object": recording.name}
            for answer, query in zip(method.predict([query.action for query in queries]), queries, strict=True)]
    ratio = rmse_ratio(sums)
    if ratio is None:
        raise MethodError(f"measure field-settings: the touches of {recording.name} that are predicted read nothing, "
                          f"and have no error over that of predicting zero. Leave the object out.")
    return ratio


def _mean(values: Mapping[str, float]) -> dict[str, Any]:
    """Mean over object views, its standard error, and the values."""
    mean, error = interval(values)
    return {"mean": mean, "error": error, "of_each_view": dict(values)}
