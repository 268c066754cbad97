"""`vsfsim evaluate --all`: every method with every preset on a task, one after the other, resumable."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vsfsim.bench.commands.evaluate import evaluate, finish
from vsfsim.bench.commands.presets import Choice
from vsfsim.bench.commands.side_by_side import Evaluation, make
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import contents_of
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task, open_dataset
from vsfsim.bench.trials.curves import beside
from vsfsim.bench.trials.training import Training
from vsfsim.core.engines.fan import HERE, Fan
from vsfsim.core.errors import Interrupted, TaskError, VsfsimError
from vsfsim.core.shelf import ceilings


@dataclass(frozen=True)
class Made:
    """What became of one row."""

    choice: Choice
    """The method and its preset."""
    path: Path
    """Its result file."""
    result: Result | None
    """The result; None where the method failed."""
    state: str
    """"made", "kept" (it was there already), or the message of the failure."""


def evaluate_all(task: Task, rows: list[Choice], folder: Path, *, dataset: Path | None = None, seeds: int | None = None,
                 before: Callable[[Choice], Any] = lambda _: None, processes: int = 1,
                 progress: Callable[[int, int, str], None] = lambda *_: None, keep: str = "", fan: Fan = HERE,
                 **options: Any) -> Iterator[Made]:
    """Make the results that are missing in a folder.

    A result is kept if it is of the same text of the task, the same dataset and the same parameters, and complete, on
    whatever device it was made. An interrupted evaluation goes on where it stopped. A method that fails is reported,
    and the next one runs.

    Args:
        task: the task. rows: what to evaluate. folder: of the result files. dataset: as of `evaluate`. seeds: as of
        `evaluate`. before: called before a row is made. processes: trainings of all rows that run at the same time.
        progress: of them, called with (done, of how many, what). keep: as of `evaluate`; a row whose predictions are
        missing is made again. fan: where the trainings run. options: further ones of `evaluate`.

    Yields:
        Every row in its order; with several processes or machines those that are there already, then the others as they
        are ready; a shard yields only these and failures.

    Raises:
        VsfsimError: the dataset is missing or does not fit the task.
    """
    data = open_dataset(task, dataset)
    to_do: dict[Path, Choice] = {}
    for choice in rows:
        path = folder / f"{choice.stem}.json"
        known = _kept(path, task, data.sha256, choice, seeds)
        if known is not None and (not keep or beside(path).is_file()):
            yield Made(choice, path, known, "kept")
            continue
        ceiling = choice.method in ceilings()
        if ceiling and fan.shard is not None:
            continue  # it has no trainings; the call that scores makes it
        if (processes > 1 or fan != HERE) and not ceiling:
            to_do[path] = choice
            continue
        before(choice)
        try:
            result = evaluate(choice.method, task, data, parameters=choice.parameters, seeds=seeds, out=path,
                              preset=choice.preset, keep=keep, processes=processes, **options)
        except Interrupted:
            raise
        except VsfsimError as error:
            yield Made(choice, path, None, str(error))
        else:
            yield Made(choice, path, result, "made")
    if to_do:
        isolation = Isolation(options.get("sandbox", ""), options.get("timeout"), options.get("memory"),
                              options.get("workers", 1))
        jobs = [Evaluation(path, c.method, task, data,
                           partial(finish, c.method, task, data, path, parameters=c.parameters, seeds=seeds,
                                   preset=c.preset, isolation=isolation, curves=beside(path) if keep else None),
                           c.parameters, seeds, Training(), isolation)
                for path, c in to_do.items()]
        for one, message in make(jobs, processes, fan=fan, progress=progress):
            yield Made(to_do[one.path], one.path, None if message else Result.load(one.path), message or "made")


def _kept(path: Path, task: Task, dataset_sha256: str, choice: Choice, seeds: int | None) -> Result | None:
    if not path.is_file():
        return None
    try:
        result = Result.load(path)
    except TaskError:
        return None
    same = (result.task_sha256, result.dataset_sha256, result.method, result.preset) == (
        task.sha256, dataset_sha256, choice.method, choice.preset)
    runs = len(task.protocol.runs(seeded="seed" in result.parameters)) if seeds is None else seeds
    asked = all(result.parameters.get(key) == value for key, value in choice.parameters.items() if key != "device")
    if not (same and asked and len(result.seeds) == runs):
        return None
    here = contents_of(choice.method, result.parameters)
    # of the harness, what it makes of the same answers is computed again by the board
    return result if all(result.contents.get(key) == here[key] for key in here if key != "the harness") else None
