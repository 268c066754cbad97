"""Rows of those who know the true object: ceilings, which bound what a task allows and are never ranked.

A ceiling is an entry point of the group `vsfsim.ceilings`, a function that is given a dataset's recipe, the name of an
object view and the actions of its query touches, and returns the touches. `resim` makes them again with the true mesh
and field (`vsfsim.generate.resim`); its error is what the task's questions leave open to a perfect model.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.commands.presets import Choice
from vsfsim.bench.method import Action, contents_of
from vsfsim.bench.metrics import Answer
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.bench.predictions import result_of
from vsfsim.bench.protocol import divide, record
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Answers
from vsfsim.bench.trials.curves import Curves, beside
from vsfsim.bench.trials.folds import test_names
from vsfsim.bench.trials.subject import Trial
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.core.scene import parse_scene
from vsfsim.core.shelf import ceilings
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe

PARAMETERS = {"tier": "", "device": "cpu"}
"""Of every ceiling: the tier of its simulation, "" for the dataset's own, and its Warp device."""


def ceiling_rows(task: Task, dataset: Dataset) -> list[Choice]:
    """The ceilings that a task can have: where it asks for readings of touches by a rigid probe."""
    scene = parse_scene(dataset.recipe.scene_text, f"{dataset.recipe.scene}.toml").sample(0)
    asked = task.metric.answer is Answer.READINGS and scene.effector == "probe"
    return [Choice(name, "", {}) for name in ceilings()] if asked else []


def evaluate_ceiling(name: str, task: Task, dataset: Dataset, *, parameters: Mapping[str, Any] | None = None,
                     processes: int = 1, progress: Callable[[int, int, str], None] | None = None,
                     out: Path | None = None, keep: str = "") -> Result:
    """The result of a ceiling: the same answers at every number of touches.

    Args:
        name: of an entry point of `vsfsim.ceilings`. task: the task. dataset: its dataset. parameters: over
        `PARAMETERS`. processes: objects at the same time. progress: called with (objects done, of how many, name).
        out: result file, or None. keep: as of `vsfsim.bench.commands.evaluate.evaluate`.

    Raises:
        MethodError: an unknown parameter.
        VsfsimError: the dataset's object cannot be asked again.
    """
    for key in parameters or {}:
        if key not in PARAMETERS:
            raise MethodError(f"the ceiling {name} has no parameter '{key}'. {did_you_mean(key, PARAMETERS)}")
    given = {**PARAMETERS, **(parameters or {})}
    names = test_names(dataset, task.protocol)
    asked = {}
    for one in names:
        view = dataset.blind().load(one)
        queries = record(view, task).queries
        asked[one] = [queries[index].action for index in divide(view, task.protocol).query]
    began = time.perf_counter()
    work = partial(_ask, ceilings()[name], dataset.recipe, given)
    said: dict[str, tuple[list[np.ndarray], int]] = {}
    for one, answer in zip(names, _each(work, names, [asked[one] for one in names], processes), strict=True):
        said[one] = answer
        if progress is not None:
            progress(len(said), len(names), one)
    lost = sum(number for _, number in said.values())
    answers = [Answers(Trial(one, shot, run, ()), tuple(said[one][0]), None, None, None, None, None, 0.0, 0.0)
               for one in names for shot in task.protocol.labels for run in task.protocol.runs(seeded=False)]
    notes = ("a ceiling: it knows the true object and no touch",
             *([f"{lost} frames without a converged answer are interpolated"] if lost else []))
    result = result_of(answers, task, dataset, method=name, entry=ceilings()[name].value, parameters=given,
                       notes=notes, data=fingerprint.beside_record(task, dataset), contents=contents_of(name, given),
                       timing={"predict_s": time.perf_counter() - began, "predicts": sum(map(len, asked.values()))})
    if out is not None:
        result.save(out)
        if keep:
            Curves.of(answers, task, dataset, result.seeds).save(beside(out))
    return result


def _each(work: Callable[..., Any], names: Sequence[str], asked: Sequence[list[Action]], processes: int
          ) -> Iterator[Any]:
    if processes == 1:
        yield from map(work, names, asked)
        return
    with ProcessPoolExecutor(processes, multiprocessing.get_context("spawn")) as pool:
        yield from pool.map(work, names, asked)


def _ask(ceiling: EntryPoint, recipe: Recipe, parameters: Mapping[str, Any], name: str, actions: Sequence[Action]
         ) -> tuple[list[np.ndarray], int]:
    """Readings (T, d) of each action, and the number of frames that had no answer of their own."""
    out, lost = [], 0
    for action, touch in zip(actions, ceiling.load()(recipe, name, actions, **parameters), strict=True):
        row = OBSERVATIONS[action.observation]
        values = row.channel.clean(touch)
        if values is None:
            raise MethodError(f"the ceiling cannot answer '{action.observation}' of object view '{name}': what it "
                              f"makes again has no {row.channel.name}.")
        reading = row.reading(values, action.axis)
        good = touch.converged & np.isfinite(reading).all(axis=1)
        lost += int((~good).sum())
        frames = np.arange(len(good))
        out.append(np.stack([np.interp(frames, frames[good], column[good]) if good.any() else np.zeros(len(good))
                             for column in reading.T], axis=1))
    return out, lost
