"""`vsfsim.evaluate(method, task)` and `vsfsim evaluate`: run methods through tasks and score them, our baselines and
everybody else's methods by the same code.

A method runs in processes of its own (`vsfsim.bench.isolation`), a fresh copy of what it learned in every trial
(`vsfsim.bench.trials.jobs`). Only when all its answers are there, the truth is read and the answers are scored
(`vsfsim.bench.trials.score`).

Threads make the jobs of a result, as the work is in the processes. What a job answered is kept beside the
result, and a second call with the same operands makes only what is missing. Where a method's ``device`` is "cuda",
without a number, its trainings are shown one GPU each, in turn. Instead of this machine, a Ray cluster or the shards of
a job array may run the jobs (`vsfsim.core.system.engines`), over a folder that their machines share.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.commands.catalogue import preset as chosen
from vsfsim.bench.commands.ceiling import evaluate_ceiling
from vsfsim.bench.identity import SCORER, changed
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.isolation.process import UNKNOWN
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.bench.trials.answers import Reader
from vsfsim.bench.trials.jobs import Evaluation, Job, Progress
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.core.errors import Interrupted, MethodError, TaskError, VsfsimError
from vsfsim.core.shelf import ceilings
from vsfsim.core.system import engines
from vsfsim.core.system.engines import HERE, Fan
from vsfsim.core.system.file_lock import release, take
from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.archive import unpack


def evaluate(method: str, task: str | Path | Task, dataset: str | Path | Dataset | None = None, *,
             parameters: Mapping[str, Any] | None = None, seeds: int | None = None, workers: int = 1,
             timeout: float | None = None, memory: float | None = None, sandbox: str = "",
             out: str | Path | None = None, preset: str = "", check: bool = True,
             training: Training = PLAIN, progress: Progress = lambda *_: None) -> Result:
    """Score a method on a task; `vsfsim.evaluate` is this function.

    Args:
        method: name of an installed method, or module:attribute; it runs in a process of its own. "resim" and "fem-map"
            are ceilings (`vsfsim.bench.commands.ceiling`).
        task: name of a shipped task, path of a .toml file, or a loaded task; TASK-development or TASK-seed-N is TASK on
            other objects (`vsfsim.bench.task.load_task`).
        dataset: its folder; None for the task's, under datasets/ or $VSFSIM_DATASETS.
        parameters: of the method's constructor, over its defaults and those of ``preset``.
        seeds: draws of the support set, None for the task's own number.
        workers: trainings and trials that run at the same time, each in a process of its own.
        timeout: seconds that one call of the method may take, None for no limit.
        memory: memory that a process of the method may allocate [GiB], None for no limit.
        sandbox: "namespaces", a container, which hides files and network, or "process"; "" for the strongest one that
            works here.
        out: result file to write, or None; `vsfsim leaderboard` reads it. Finished trainings are kept beside it until
            all are done, and what the method prints goes to a file beside it, RESULT.json.log.
        preset: "paper", "exact" or "tuned", settings of a method that ships; "" for none.
        check: test the method's contract on mock objects first.
        training: what the method learns from, where a study departs from the task: such a result is never ranked.
        progress: called with (trials done, of how many, what is going on).

    Raises:
        VsfsimError: the method, the task or the dataset is unknown or does not fit, or the method raised.
    """
    if not isinstance(method, str):
        raise MethodError(f"method is {method!r}; give the name of an installed method, or module:attribute of one in "
                          "a file (in a notebook: %%writefile mine.py as the first line of its cell).")
    wanted = task if isinstance(task, Task) else load_task(task)
    row = chosen(method, preset, wanted.observation.name, wanted.metric.answer.value)
    row = replace(row, parameters={**row.parameters, **(parameters or {})})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json" if out is None else Path(out)
        (made,) = evaluate_all(wanted, {path: row}, dataset=dataset, again=True, seeds=seeds, workers=workers,
                               timeout=timeout, memory=memory, sandbox=sandbox, check=check,
                               training=training, progress=progress)
    if made.failure is not None:
        raise made.failure
    assert made.result is not None
    return made.result


@dataclass(frozen=True)
class Made:
    """What became of one row."""

    path: Path
    """Its result file."""
    result: Result | None = None
    """The result; None where the method failed."""
    failure: VsfsimError | None = None
    """Why there is no result."""
    kept: bool = False
    """The result was there already."""

    @property
    def state(self) -> str:
        """"made", "kept", or the message of the failure."""
        return str(self.failure) if self.failure is not None else "kept" if self.kept else "made"


def evaluate_all(task: Task, rows: Mapping[Path, Choice], *, dataset: str | Path | Dataset | None = None,
                 again: bool = False, seeds: int | None = None, workers: int = 1, timeout: float | None = None,
                 memory: float | None = None, sandbox: str = "", check: bool = True,
                 training: Training = PLAIN, fan: Fan = HERE, progress: Progress = lambda *_: None
                 ) -> Iterator[Made]:
    """Make results on a task.

    An interrupted evaluation goes on where it stopped. A method that fails is reported, and the next one runs.

    Args:
        task: the task.
        rows: what to evaluate, by the result file.
        again: make results that are there again; else one is kept if it is of the same text of the task, the same
            dataset and the same parameters, and complete, on whatever device it was made.
        dataset, seeds, workers, timeout, memory, sandbox, check, training: as of `evaluate`.
        fan: where the trainings run.
        progress: called with (trials done of a row, of how many, what).

    Yields:
        Those that are there already and ceilings, then the others as they are ready; a shard yields only these and
        failures.

    Raises:
        VsfsimError: a method is unknown; the dataset is missing or does not fit the task.
    """
    for choice in rows.values():
        if choice.method not in ceilings():
            check_name(choice.method)
    data = data_of(task, dataset.path if isinstance(dataset, Dataset) else dataset, progress)
    isolation, wanted = Isolation(sandbox, timeout, memory), list[Evaluation]()
    for path, choice in rows.items():
        known = None if again else _kept(path, task, data.sha256, choice, seeds)
        if known is not None:
            yield Made(path, known, kept=True)
        elif choice.method not in ceilings():
            wanted.append(Evaluation(choice.method, task, data, path, choice.parameters, seeds, isolation, training,
                                     choice.preset))
        elif fan.shard is None:  # a ceiling has no trainings; the call that scores makes it
            try:
                yield Made(path, evaluate_ceiling(
                    choice.method, task, data, path, parameters=choice.parameters, workers=workers,
                    progress=progress))
            except VsfsimError as error:
                yield Made(path, failure=error)
    yield from make(wanted, workers, check=check, fan=fan, progress=progress)


def data_of(task: Task, path: str | Path | None = None, progress: Progress = lambda *_: None) -> Dataset:
    """The task's dataset, unpacked if it is missing and its archive is there (`vsfsim.data.formats.archive`); operands
    and errors as of `vsfsim.bench.task.open_dataset`."""
    if path is None:
        unpack(task.dataset, task.dataset.path(), lambda said: progress(0, 1, said))
    return open_dataset(task, path)


def _kept(path: Path, task: Task, dataset_sha256: str, choice: Choice, seeds: int | None) -> Result | None:
    try:
        result = Result.load(path)
    except TaskError:  # none, or a damaged one
        return None
    runs = len(task.protocol.runs(seeded="seed" in result.parameters)) if seeds is None else seeds
    if not is_of(result, task, choice) or (result.dataset_sha256, len(result.seeds)) != (dataset_sha256, runs):
        return None
    # what the scorer makes of the same answers is computed again by the board
    return result if set(changed(choice.method, result.parameters, result.contents)) <= {SCORER} else None


def is_of(result: Result, task: Task, choice: Choice) -> bool:
    """Whether a result is of this text of the task and of a method with these settings."""
    return (result.task_sha256, result.method, result.preset) == (
        task.sha256, choice.method, choice.preset) and result.has(choice.parameters)


@contextlib.contextmanager
def own(result: Path) -> Iterator[None]:
    """Hold the result file ``result`` for this process: two evaluations that write one would mix their answers.

    Raises:
        MethodError: another evaluation writes it, or its folder cannot be written.
    """
    path = result.with_name(f".{result.name}.lock")
    made = [folder for folder in (result.parent, *result.parent.parents) if not folder.exists()]
    lock, _ = take(path, result, MethodError)
    try:
        yield
    finally:
        release(lock)
        with contextlib.suppress(OSError):  # what the evaluation wrote stays, and so do its folders
            for folder in made:
                folder.rmdir()


def make(rows: Iterable[Evaluation], workers: int, *, check: bool = True, fan: Fan = HERE,
         progress: Progress = lambda *_: None) -> Iterator[Made]:
    """Make results, one after the other.

    Args:
        rows: what to make; their results must have different paths.
        workers: trainings and trials that run at the same time, each in a process of its own.
        check: test each method's contract on mock objects first.
        fan: where the jobs run; a shard makes its share of the trainings and scores nothing.
        progress: called with (trials done of a row, of how many, what is going on).

    Yields:
        What became of each row when it is finished; of a shard only failures.

    Raises:
        Interrupted: the user has stopped it; finished trainings are kept.
    """
    counted, reader = itertools.count(), Reader()  # all trainings, so that every shard counts alike
    for row in rows:
        failure, result = None, None
        try:
            with own(row.path) if fan.shard is None else contextlib.nullcontext(), row:
                progress(0, 1, f"{row.path.stem}: contract and dataset")
                row.look(check=check)
                mine = [job for job in row.jobs if fan.shard is None or next(counted) % fan.shard[1] == fan.shard[0]]
                _run(row, mine, workers, reader, fan, progress)
                result = row.finish() if fan.shard is None else None
        except KeyboardInterrupt as stop:
            known = row.said is not UNKNOWN
            done, of = (len(row.jobs) - len(row.left), len(row.jobs)) if known else (0, 0)
            raise Interrupted("interrupted; no training was finished, so nothing is kept." if not done else
                              f"interrupted; {done} of {of} trainings are finished and kept in {row.parts}. Run the "
                              f"same command again to go on, or delete what is kept to start again.") from stop
        except VsfsimError as error:
            if fan.ray and type(error) is VsfsimError:  # the cluster's, and not the row's
                raise
            failure = error
        if failure is not None or fan.shard is None:
            yield Made(row.path, result, failure)


def _run(row: Evaluation, jobs: Sequence[Job], workers: int, reader: Reader, fan: Fan, progress: Progress) -> None:
    """Make those of some jobs that are not kept.

    Raises:
        VsfsimError: what went wrong first.
    """
    left = [job for job in row.left if job in jobs]
    total = sum(map(row.trials, jobs))
    done, lock = total - sum(map(row.trials, left)), threading.Lock()

    def tell(number: int, what: str) -> None:
        nonlocal done
        with lock:
            done += number
            progress(done, total, what)

    if fan.ray:  # a path must mean the same there
        there = replace(row, path=row.path.absolute(),
                        dataset=replace(row.dataset, path=row.dataset.path.absolute()))
        for number, message in engines.on_ray(_train, [(there, job) for job in left], address=fan.ray, gpus=fan.gpus):
            tell(row.trials(left[number]), left[number].name)
            if message:
                raise MethodError(message)
        return
    gpus = _gpus() if row.parameters.get("device") == "cuda" else []
    # trainings that run side by side share the cores
    threads = os.environ.get("OMP_NUM_THREADS") or str(max((os.cpu_count() or 1) // workers, 1))
    with ThreadPoolExecutor(workers) as waits, ThreadPoolExecutor(workers) as pool:
        going = [waits.submit(row.make, job, reader, pool, tell, {"OMP_NUM_THREADS": threads} | (
            {"CUDA_VISIBLE_DEVICES": gpus[number % len(gpus)]} if gpus else {}))
                 for number, job in enumerate(left)]
        try:
            for ready in as_completed(going):
                ready.result()
        except BaseException:
            for one in (waits, pool):
                one.shutdown(wait=False, cancel_futures=True)
            row.stop()  # so that the threads end as well
            raise


def _train(item: tuple[Evaluation, Job]) -> None:
    """In a task of a cluster."""
    one, job = item
    with one, ThreadPoolExecutor(1) as pool:
        one.make(job, Reader(), pool)


def _gpus() -> list[str]:
    """What CUDA_VISIBLE_DEVICES may name here."""
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is not None:
        return [name.strip() for name in shown.split(",") if name.strip()]
    return [str(k) for k in range(len(list(Path("/dev").glob("nvidia[0-9]*"))))]
