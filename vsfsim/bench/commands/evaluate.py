"""`vsfsim.evaluate(method, task)` and `vsfsim evaluate`: a score from names; `--all`: every method with every preset
on a task, one after the other, resumable."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.bench.commands.ceiling import evaluate_ceiling
from vsfsim.bench.commands.presets import Choice
from vsfsim.bench.commands.presets import preset as chosen
from vsfsim.bench.curves import beside
from vsfsim.bench.evaluate import Row, finish, make
from vsfsim.bench.identity import SCORER, contents_of
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.core.errors import Interrupted, MethodError, TaskError, VsfsimError
from vsfsim.core.shelf import ceilings
from vsfsim.core.system.engines import HERE, Fan
from vsfsim.data.dataset import Dataset


def evaluate(method: str | type, task: str | Path | Task, dataset: str | Path | Dataset | None = None, *,
             parameters: Mapping[str, Any] | None = None, seeds: int | None = None, workers: int = 1,
             timeout: float | None = None, memory: float | None = None, sandbox: str = "",
             out: str | Path | None = None, preset: str = "", processes: int = 1, keep: str = "",
             progress: Callable[[int, int, str], None] = lambda *_: None) -> Result:
    """Score a method on a task; `vsfsim.evaluate` is this function.

    Args:
        method: name of an installed method, module:attribute, or a class of an importable module. It runs in a process
            of its own. "resim" and "fem-map" are ceilings (`vsfsim.bench.commands.ceiling`).
        task: name of a shipped task, path of a .toml file, or a loaded task; TASK-development or TASK-seed-N is TASK on
        other objects (`vsfsim.bench.task.load_task`).
        dataset: its folder; None for the task's, under datasets/ or $VSFSIM_DATASETS.
        parameters: of the method's constructor, over its defaults.
        seeds: draws of the support set, None for the task's own number.
        workers: trials that run at the same time.
        timeout: seconds that one call of the method may take, None for no limit.
        memory: memory that a process of the method may allocate [GiB], None for no limit.
        sandbox: "namespaces", a container, which hides files and network, or "process"; "" for the strongest one that
            works here.
        out: result file to write, or None; `vsfsim leaderboard` reads it. Finished seeds are kept beside it until all
            are done, and what the method prints goes to a file beside it, RESULT.json.log.
        preset: "paper" or "tuned", settings of a method that ships; ``parameters`` go over them. "" for none.
        processes: trainings that run at the same time, each in a process of its own.
        keep: "predictions" writes every prediction beside the truth, RESULT.predictions.npz, which `vsfsim view`
        draws; "" writes none.
        progress: called with (trials done, of how many, what is going on).

    Raises:
        VsfsimError: the method, the task or the dataset is unknown or does not fit, or the method raised.
    """
    name = method if isinstance(method, str) else name_of(method)
    if name not in ceilings():
        check_name(name)
    if keep not in ("", "predictions") or (keep and out is None):
        raise MethodError(f"keep is '{keep}' and out is {out}; keep is '' or 'predictions', which are written beside "
                          f"the result file of out.")
    wanted = task if isinstance(task, Task) else load_task(task)
    data = open_dataset(wanted, dataset.path if isinstance(dataset, Dataset) else dataset)
    if name in ceilings():
        return evaluate_ceiling(name, wanted, data, parameters=parameters, processes=processes, progress=progress,
                                out=None if out is None else Path(out), keep=keep)
    isolation = Isolation(sandbox, timeout, memory, workers)
    if preset:
        parameters = {**chosen(name, preset, wanted.observation.name, wanted.metric.answer.value).parameters,
                      **(parameters or {})}
    options: dict[str, Any] = {"parameters": parameters, "preset": preset, "seeds": seeds, "isolation": isolation}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json" if out is None else Path(out)
        if keep:
            options["curves"] = beside(path)
        return finish(name, wanted, data, path, processes=processes, progress=progress, **options)


def name_of(method: type) -> str:
    """The name module:attribute of a class.

    Raises:
        MethodError: it cannot be imported under that name, e.g. because it was written into a notebook's cell.
    """
    module, attribute = getattr(method, "__module__", None), getattr(method, "__qualname__", str(method))
    if module is None or module == "__main__" or "." in attribute:
        raise MethodError(f"the method {attribute} is not an attribute of a module that can be imported. Save it in a "
                          f"file, e.g. mine.py (in a notebook: %%writefile mine.py as the first line of the cell), and "
                          f"give 'mine:{attribute.rpartition('.')[2]}'.")
    return f"{module}:{attribute}"


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
                 processes: int = 1, progress: Callable[[int, int, str], None] = lambda *_: None, keep: str = "",
                 fan: Fan = HERE, workers: int = 1, timeout: float | None = None, memory: float | None = None,
                 sandbox: str = "") -> Iterator[Made]:
    """Make the results that are missing in a folder.

    A result is kept if it is of the same text of the task, the same dataset and the same parameters, and complete, on
    whatever device it was made. An interrupted evaluation goes on where it stopped. A method that fails is reported,
    and the next one runs.

    Args:
        task: the task. rows: what to evaluate. folder: of the result files; of one row the file itself. dataset,
        seeds, workers, timeout, memory, sandbox: as of `evaluate`. processes: trainings of all rows that run at the
        same time. progress: of them, called with (done, of how many, what). keep: as of `evaluate`; a row whose
        predictions are missing is made again. fan: where the trainings run.

    Yields:
        Those that are there already and ceilings, then the others as they are ready; a shard yields only these and
        failures.

    Raises:
        VsfsimError: the dataset is missing or does not fit the task.
    """
    data, isolation = open_dataset(task, dataset), Isolation(sandbox, timeout, memory, workers)
    to_do: dict[Path, tuple[Choice, Row]] = {}
    for choice in rows:
        path = folder if folder.suffix == ".json" and len(rows) == 1 else folder / f"{choice.stem}.json"
        known = _kept(path, task, data.sha256, choice, seeds)
        if known is not None and (not keep or beside(path).is_file()):
            yield Made(choice, path, known, "kept")
        elif choice.method not in ceilings():
            to_do[path] = choice, Row.at(path, choice.method, task, data, parameters=choice.parameters, seeds=seeds,
                                         preset=choice.preset, isolation=isolation,
                                         curves=beside(path) if keep else None)
        elif fan.shard is None:  # a ceiling has no trainings; the call that scores makes it
            try:
                result = evaluate_ceiling(choice.method, task, data, parameters=choice.parameters, out=path, keep=keep,
                                          processes=processes, progress=progress)
            except Interrupted:
                raise
            except VsfsimError as error:
                yield Made(choice, path, None, str(error))
            else:
                yield Made(choice, path, result, "made")
    wanted = [row for _, row in to_do.values()]
    # one after the other, unless trainings of several run at the same time
    for some in ([wanted] if processes > 1 or fan != HERE else [[row] for row in wanted]):
        for row, made in make(some, processes, fan=fan, progress=progress):
            given = (None, str(made)) if isinstance(made, VsfsimError) else (made, "made")
            yield Made(to_do[row.path][0], row.path, *given)


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
    here = contents_of(choice.method, result.parameters, opened=result.contents)
    # what the scorer makes of the same answers is computed again by the board
    return result if all(result.contents.get(key) == here.get(key) for key in {*here, *result.contents} - {SCORER}
                         ) else None
