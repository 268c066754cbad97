"""Rows of those who know the true object: ceilings, which bound what a task allows and are never ranked.

A ceiling is an entry point of the group `vsfsim.ceilings`, a function that is given a dataset's recipe, the name of an
object view and the actions of its query touches, and returns the touches. `resim` makes them again with the true mesh
and field (`vsfsim.generate.resim`); its error is what the task's questions leave open to a perfect model. One of the
group `vsfsim.fitted_ceilings` is given the readings of each trial as ``support``, too: `fem-map`
(`vsfsim.generate.fem_map`) fits the true mesh's moduli to them, `rod-map` (`vsfsim.generate.plants.rod_map`) those of a
plant's true skeleton. Other keyword parameters are set by ``--set``.
"""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import multiprocessing
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.identity import contents_of
from vsfsim.bench.method import Action, Reading
from vsfsim.bench.metrics import Answer
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.bench.predictions import questions
from vsfsim.bench.protocol import Answers, Trial
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import load, save
from vsfsim.bench.trials.score import result_of
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.core.scene import parse_scene
from vsfsim.core.shelf import CEILING_GROUP, FITTED_GROUP, ceilings
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe

Which = tuple[str, tuple[int, ...]]
"""An object view, and the touches that a fitted ceiling is given."""
Asked = tuple[tuple[Action, ...], tuple[Reading, ...]]
"""Its query touches, and the readings of those."""


def ceiling_rows(task: Task, dataset: Dataset) -> list[Choice]:
    """The ceilings that `--all` makes of a task that asks for readings of touches by a rigid probe or a bubble. Those
    that are fitted to a support take a minute of a core for each, and are asked by their names."""
    scene = parse_scene(dataset.recipe.scene_text, f"{dataset.recipe.scene}.toml").sample(0)
    asked = task.metric.answer is Answer.READINGS and scene.effector in ("probe", "bubble")
    return [Choice(name, "", {}) for name, entry in ceilings().items() if asked and entry.group == CEILING_GROUP]


def evaluate_ceiling(name: str, task: Task, dataset: Dataset, out: Path, *, parameters: Mapping[str, Any],
                     workers: int = 1, progress: Callable[[int, int, str], None] = lambda *_: None
                     ) -> Result:
    """The result of a ceiling: the same answers at every number of touches, unless it takes a support.

    Args:
        name: of an entry point of `vsfsim.ceilings`. task: the task. dataset: its dataset. out: result file; finished
        answers are kept beside it until all are made, and taken up again. parameters: over those of its function.
        workers: answers at the same time. progress: called with (answers made, of how many, object).

    Raises:
        MethodError: an unknown parameter.
        VsfsimError: the dataset's object cannot be asked again.
    """
    entry = ceilings()[name]
    takes = {key: one.default for key, one in inspect.signature(entry.load()).parameters.items()
             if one.kind is one.KEYWORD_ONLY and key != "support"}
    for key in parameters:
        if key not in takes:
            raise MethodError(f"the ceiling {name} has no parameter '{key}'. {did_you_mean(key, takes)}")
    given, fits = {**takes, **parameters}, entry.group == FITTED_GROUP
    trials, asked = list[Trial](), dict[Which, Asked]()
    for one in questions(task, dataset):
        trials.append(Trial(one.name, one.shot, one.seed, one.given if fits else ()))
        asked[one.name, trials[-1].support] = one.actions, one.support
    began = time.perf_counter()
    contents, part = contents_of(name, given), out.with_suffix(".part")
    identity = repr((task.sha256, dataset.sha256, given, contents))
    said: dict[Which, tuple[int, list[np.ndarray]]] = {}
    with contextlib.ExitStack() as held:
        each: Callable[..., Iterator[Any]] = map
        if workers > 1:
            each = held.enter_context(ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))).map
        work = partial(_answered, part, identity, entry, dataset.recipe, given)
        for which, answer in zip(asked, each(work, list(asked), list(asked.values())), strict=True):
            said[which] = answer
            progress(len(said), len(asked), which[0])
    lost = sum(number for number, _ in said.values())
    answers = [Answers(trial, tuple(said[trial.subject, trial.support][1])) for trial in trials]
    notes = (f"a ceiling: it knows the true object{', but not its moduli' if fits else ' and no touch'}",
             *([f"{lost} frames without a converged answer are interpolated"] if lost else []))
    result = result_of(answers, task, dataset, task.protocol.runs(seeded=False), method=name, entry=entry.value,
                       parameters=given, notes=notes, data=fingerprint.beside_record(task, dataset), contents=contents,
                       timing={"predict_s": time.perf_counter() - began,
                               "predicts": sum(len(queries) for queries, _ in asked.values())})
    result.save(out)
    shutil.rmtree(part, ignore_errors=True)
    return result


def _answered(folder: Path, identity: str, ceiling: EntryPoint, recipe: Recipe, parameters: Mapping[str, Any],
              which: Which, asked: Asked) -> tuple[int, list[np.ndarray]]:
    """The number of frames that had no answer of their own, and readings (T, d) of each action; those that an earlier
    run with the same identity kept in the folder."""
    digest = hashlib.sha256(f"{identity} {which}".encode()).hexdigest()
    path = folder / f"{which[0]}-{digest[:24]}.answers"
    kept = load(path, tuple[int, list[np.ndarray]])
    if kept is not None:
        return kept
    (name, known), (actions, readings) = which, asked
    out, lost = [], 0
    for action, touch in zip(actions, ceiling.load()(
            recipe, name, actions, **({"support": readings} if known else {}), **parameters), strict=True):
        row = OBSERVATIONS[action.observation]
        values = row.channel.clean(touch)
        if values is None:
            raise MethodError(f"the ceiling cannot answer '{action.observation}' of object view '{name}': what it "
                              f"makes again has no {row.channel.name}.")
        reading = row.reading(values, action.axis)
        good = np.flatnonzero(touch.converged & np.isfinite(reading).all(axis=1))
        lost += len(reading) - len(good)
        frames = np.arange(len(action.time))  # a touch that ended at a force limit holds its last reading
        out.append(np.stack([np.interp(frames, good, column[good]) if len(good) else np.zeros(len(frames))
                             for column in reading.T], axis=1))
    save(path, (lost, out))
    return lost, out
