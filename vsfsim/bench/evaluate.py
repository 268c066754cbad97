"""Run methods through tasks and score them. The same code for our baselines and for everybody else's methods.

A method runs in processes of its own (`vsfsim.bench.isolation`), a fresh copy of what it learned in every trial
(`vsfsim.bench.trials.jobs`). Only when all its answers are there, the truth is read and the answers are scored
(`vsfsim.bench.trials.score`).

Threads make the jobs of one or several results, as the work is in the processes. What a job answered is kept beside the
result, and a second call with the same operands makes only what is missing. Where a method's ``device`` is "cuda",
without a number, each of its trainings is shown one GPU, that with the fewest of them. Instead of this machine, a Ray
cluster or the shards of a job array may run the jobs (`vsfsim.core.system.engines`), over a folder that their machines
share.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.curves import Curves
from vsfsim.bench.identity import versions_of
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result, versions
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Answers, Reader
from vsfsim.bench.trials.jobs import Evaluation, Job, Progress
from vsfsim.bench.trials.score import map_of, result_of
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.core.errors import Interrupted, MethodError, VsfsimError
from vsfsim.core.system import engines
from vsfsim.core.system.content import file_sha256
from vsfsim.core.system.engines import HERE, Fan
from vsfsim.core.system.file_lock import Held, release, take
from vsfsim.data.dataset import Dataset


@dataclass(frozen=True)
class Row:
    """A result that is to be made: an evaluation and its file."""

    path: Path
    """The file."""
    of: Evaluation
    """The evaluation; its answers are kept beside the file until all are there."""
    preset: str = ""
    """Name of the settings, for the leaderboard; they are in the evaluation's parameters already."""
    curves: Path | None = None
    """File for all predictions beside the truth (`vsfsim.bench.curves.Curves`), or None."""

    @classmethod
    def at(cls, path: Path, name: str, task: Task, dataset: Dataset, *, parameters: Mapping[str, Any] | None = None,
           seeds: int | None = None, isolation: Isolation | None = None, training: Training = PLAIN,
           **more: Any) -> Row:
        """A row at ``path``; operands as of `evaluate`, and further fields."""
        parts = path.with_suffix(".parts").absolute()
        return cls(path, Evaluation(name, task, dataset, parts, dict(parameters or {}), seeds,
                                    isolation or Isolation(), training), **more)

    def finish(self) -> Result:
        """Score the kept answers, write the result and what the method printed, and remove what was kept.

        Raises:
            MethodError: an answer is missing.
        """
        result = _scored(self.of, self.preset, self.curves)
        result.save(self.path)
        log_of(self.path).unlink(missing_ok=True)
        if text := self.printed():
            log_of(self.path).write_text(text)
        shutil.rmtree(self.of.parts, ignore_errors=True)
        return result

    def printed(self) -> str:
        """What the method printed in all its jobs."""
        return "".join(log.read_text(errors="replace") for log in sorted(self.of.parts.glob("*.log")))


def evaluate(name: str, task: Task, dataset: Dataset, *, log: str | Path | None = None, **options: Any) -> Result:
    """Score a method; the result is written nowhere.

    Args:
        name: an installed method, or module:attribute. Its module is imported in another process only.
        task: the task. dataset: as `open_dataset` returns it. log: file to which everything goes that the method
        prints; None for none. options: of `finish`.

    Raises:
        MethodError: the method is unknown, breaks its contract, raises, takes too long, or answers with something that
            cannot be scored.
        TaskError: the dataset has too few touches.
        Interrupted: the user has stopped it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        result = finish(name, task, dataset, path, **options)
        if log is not None:
            Path(log).write_text(log_of(path).read_text() if log_of(path).is_file() else "")
        return result


def finish(name: str, task: Task, dataset: Dataset, path: Path, *, check: bool = True, processes: int = 1,
           progress: Progress = lambda *_: None, **options: Any) -> Result:
    """Score a method and write the result. Finished trainings are kept beside it, and a second call with the same
    operands goes on with them.

    Args:
        name, task, dataset: as of `evaluate`. path: of the result. check, processes, progress: as of `make`.
        options: ``parameters`` of the method's constructor, over its defaults; ``seeds``, draws of the support set,
            None for the task's own number; with cross-validation, of one training; ``isolation``, how the method is
            kept from what it may not see, None for the strongest sandbox that works here; ``preset``, name of the
            settings, for the leaderboard; they are in ``parameters`` already; ``training``, what the method learns
            from, where a study departs from the task (`vsfsim papers study`): such a result is never ranked;
            ``curves``, file for all predictions beside the truth (`vsfsim.bench.curves.Curves`).

    Raises:
        As `evaluate`.
    """
    check_name(name)
    ((_, made),) = make([Row.at(path, name, task, dataset, **options)], processes, check=check, progress=progress)
    if isinstance(made, VsfsimError):
        raise made
    return made


@contextlib.contextmanager
def own(result: Path) -> Iterator[None]:
    """Hold the result file ``result`` for this process: two evaluations that write one would mix their answers.

    Raises:
        MethodError: another evaluation writes it, or its folder cannot be written.
    """
    path = result.with_name(f".{result.name}.lock")
    made = [folder for folder in (result.parent, *result.parent.parents) if not folder.exists()]
    try:
        result.parent.mkdir(parents=True, exist_ok=True)
        lock, _ = take(path, unlocked=True)
    except Held as held:
        raise MethodError(f"{result} is being written by process {held}. Wait for it, stop it, or choose another "
                          f"--out.") from None
    except OSError as error:
        raise MethodError(f"{result} cannot be written: {error.strerror}. Choose another --out.") from error
    try:
        yield
    finally:
        release(lock)
        with contextlib.suppress(OSError):  # what the evaluation wrote stays, and so do its folders
            for folder in made:
                folder.rmdir()


def make(rows: Sequence[Row], processes: int, *, check: bool = True, fan: Fan = HERE,
         progress: Progress = lambda *_: None) -> Iterator[tuple[Row, Result | VsfsimError]]:
    """Make results side by side.

    Args:
        rows: what to make; their results must have different paths.
        processes: trainings that run at the same time, each with one thread unless the environment says otherwise.
        check: test each method's contract on mock objects first.
        fan: where the jobs run; a shard makes its share of the trainings and scores nothing.
        progress: called with (trials done, of how many, what is going on).

    Yields:
        Each row when it is finished, with its result or its failure; of a shard only failures.

    Raises:
        Interrupted: the user has stopped it; finished trainings are kept.
    """
    counted = itertools.count()  # all trainings, so that every shard counts alike whatever is finished
    reader, queue, left, trials = Reader(), list[tuple[Row, Job]](), dict[Path, int](), _Count(progress)
    try:
        with contextlib.ExitStack() as held:
            for row in rows:
                try:
                    if fan.shard is None:
                        held.enter_context(own(row.path))
                    held.enter_context(row.of)
                    progress(0, 1, f"{row.path.stem}: contract and dataset")
                    row.of.look(check=check)
                    mine = [job for job in row.of.jobs
                            if fan.shard is None or next(counted) % fan.shard[1] == fan.shard[0]]
                    jobs = [job for job in row.of.left if job in mine]
                    if not fan.ray:
                        row.of.read(jobs, reader)
                except VsfsimError as error:
                    yield row, error
                    continue
                queue += [(row, job) for job in jobs]
                trials.add(row.of, mine, jobs)
                left[row.path] = len(jobs)
                if not jobs and fan.shard is None:
                    yield row, _finished(row)
            made = _by_ray(queue, fan, trials) if fan.ray else _by_threads(queue, processes, reader, trials)
            for number, failure in made:
                row, _ = queue[number]
                left[row.path] -= 1
                if failure is not None and left[row.path] >= 0:
                    left[row.path] = -1  # the first failure is told, and nothing after it
                    yield row, failure
                elif left[row.path] == 0 and fan.shard is None:
                    yield row, _finished(row)
    except KeyboardInterrupt as stop:
        known = [row.of for row in rows if row.of.description is not None]
        done, of = sum(len(one.jobs) - len(one.left) for one in known), sum(len(one.jobs) for one in known)
        raise Interrupted("interrupted; no training was finished, so nothing is kept." if not done else
                          f"interrupted; {done} of {of} trainings are finished and kept in "
                          f"{', '.join(str(one.parts) for one in known)}. Run the same command again to go on, or "
                          f"delete what is kept to start again.") from stop


class _Count:
    """Tells how many trials of all rows are done, whichever thread has done them."""

    def __init__(self, progress: Progress):
        self._progress, self._lock, self.done, self.total = progress, threading.Lock(), 0, 0

    def add(self, of: Evaluation, jobs: Sequence[Job], left: Sequence[Job]) -> None:
        """Count the trials of some jobs, and those that are not ``left`` as done."""
        sizes = {job.name: len(job.asked(of.task.protocol.labels)) for job in jobs}
        self.total += sum(sizes.values())
        self.done += sum(sizes.values()) - sum(sizes[job.name] for job in left)

    def tell(self, number: int, what: str) -> None:
        """More trials are done."""
        with self._lock:
            self.done += number
            self._progress(self.done, self.total, what)


def _finished(row: Row) -> Result | VsfsimError:
    try:
        return row.finish()
    except VsfsimError as error:
        return error


def _by_threads(queue: Sequence[tuple[Row, Job]], processes: int, reader: Reader, trials: _Count
                ) -> Iterator[tuple[int, VsfsimError | None]]:
    """The number of each job in ``queue`` as it ends, with what went wrong."""
    gpus, failed = _Gpus(), set[Path]()

    def work(row: Row, job: Job) -> VsfsimError | None:
        if row.path in failed:
            return MethodError("not made")
        with gpus.one(row.of.parameters.get("device") == "cuda") as given:
            try:
                row.of.make(job, reader, trials.tell, environment=given)
            except VsfsimError as error:
                failed.add(row.path)
                return error
        return None

    with ThreadPoolExecutor(processes) as pool:
        numbers = {pool.submit(work, row, job): number for number, (row, job) in enumerate(queue)}
        try:
            for ready in as_completed(numbers):
                yield numbers[ready], ready.result()
        except BaseException:  # Ctrl-C, or nobody asks for more
            pool.shutdown(wait=False, cancel_futures=True)
            for row, _ in queue:
                row.of.stop()
            raise


def _by_ray(queue: Sequence[tuple[Row, Job]], fan: Fan, trials: _Count) -> Iterator[tuple[int, VsfsimError | None]]:
    """As `_by_threads`, on a cluster; a path must mean the same there."""
    items = [(replace(row.of, dataset=replace(row.of.dataset, path=row.of.dataset.path.absolute())), job)
             for row, job in queue]
    for number, message in engines.on_ray(_train, items, address=fan.ray, gpus=fan.gpus):
        row, job = queue[number]
        trials.tell(len(job.asked(row.of.task.protocol.labels)), job.name)
        yield number, MethodError(message) if message else None


def _train(item: tuple[Evaluation, Job]) -> None:
    """In a task of a cluster."""
    one, job = item
    with one:
        one.make(job, Reader())


class _Gpus:
    """What CUDA_VISIBLE_DEVICES may name here, each with the number of trainings that use it."""

    def __init__(self) -> None:
        shown = os.environ.get("CUDA_VISIBLE_DEVICES")
        names = ([str(k) for k in range(len(list(Path("/dev").glob("nvidia[0-9]*"))))] if shown is None else
                 [name.strip() for name in shown.split(",") if name.strip()])
        self._used, self._lock = dict.fromkeys(names, 0), threading.Lock()

    @contextlib.contextmanager
    def one(self, any_of_them: bool) -> Iterator[Mapping[str, str]]:
        """The variable that shows the GPU which is used least; {} where there is none, or not any of them may be."""
        with self._lock:
            name = min(self._used, key=lambda one: self._used[one], default="") if any_of_them else ""
            self._used.update({name: self._used[name] + 1} if name else {})
        try:
            yield {"CUDA_VISIBLE_DEVICES": name} if name else {}
        finally:
            with self._lock:
                self._used.update({name: self._used[name] - 1} if name else {})


def log_of(result: Path) -> Path:
    """The file beside a result that holds what the method printed: RESULT.json.log, as RESULT.log may be the user's."""
    return result.with_name(result.name + ".log")


def _scored(one: Evaluation, preset: str, curves: Path | None) -> Result:
    """The result of an evaluation whose jobs are all kept."""
    answers, done = one.answers()
    said, task, dataset, plain = one.said, one.task, one.dataset, not one.training.table()
    if curves is not None:
        Curves.of(answers, task, dataset, one.runs).save(curves)
    timing = {"meta_fit_s": sum(job.meta_fit_s for job in done), "fits": len(done),
              "adapt_s": sum(a.adapt_s for a in answers), "predict_s": sum(a.predict_s for a in answers),
              "adapts": sum(a.adapt_s > 0.0 for a in answers),
              "predicts": sum(len(a.readings) for a in answers if a.adapt_s > 0.0)}
    notes = [f"superseded by {task.superseded_by}"] if task.superseded_by else []
    wanted = len(task.protocol.runs(seeded=said.seeded))
    if len(one.runs) != wanted:
        notes.append(f"{len(one.runs)} seeds instead of the task's {wanted}")
    opened = {name: file_sha256(Path(name)) for job in done for name in job.opened}
    return result_of(answers, task, dataset, one.runs, method=one.method, entry=said.entry,
                     parameters=dict(said.parameters), timing=timing,
                     peak_memory_mib=round(max(job.peak_memory_mib for job in done), 1), notes=tuple(notes),
                     package={"name": said.package, "version": said.version}, isolation=one.isolation.sandbox,
                     contents={**one.contents, **opened}, preset=preset,
                     data=fingerprint.beside_record(task, dataset) if plain else {},
                     study=one.training.table(), versions={**versions_of(one.method), **versions()},
                     maps=_maps(answers, task, dataset) if plain else {})


def _maps(answers: list[Answers], task: Task, dataset: Dataset) -> dict[str, list]:
    """`Result.maps` of a task with cross-validation: of the first run at the shot that ranks, and of the first view of
    each object, because all of them would be most of a result file."""
    out: dict[str, list] = {}
    shown = {e.name for e in dataset.entries if e.view_index == 0}
    first = [a for a in answers if (a.trial.shot, a.trial.seed) == (task.ranking_shot, 0) and a.mean is not None
             and a.trial.subject in shown]
    for given in first if task.protocol.folds else ():
        for column, values in map_of(given, dataset).items():
            out.setdefault(column, []).extend(values)
    return out
