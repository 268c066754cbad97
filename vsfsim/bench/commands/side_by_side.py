"""Rows whose trainings run side by side: a pool of threads over the jobs of all of them.

A job's work is in processes of the method's own, so that threads suffice here. What a job answered is kept beside the
result, and a second call with the same operands makes only what is missing. Where a method's ``device`` is "cuda",
without a number, each of its trainings is shown one GPU, that with the fewest of them. Instead of this machine, a Ray
cluster or the shards of a job array may run the jobs (`vsfsim.core.system.engines`), over a folder that their machines
share.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

from vsfsim.bench.trials.answers import Reader
from vsfsim.bench.trials.jobs import Evaluation, Job
from vsfsim.core.errors import Interrupted, MethodError, VsfsimError
from vsfsim.core.system import engines
from vsfsim.core.system.engines import HERE, Fan
from vsfsim.core.system.file_lock import Held, release, take

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class _Row(Protocol):
    """As `vsfsim.bench.evaluate.Row`."""

    @property
    def path(self) -> Path:
        """Of the result."""

    @property
    def of(self) -> Evaluation:
        """What makes its answers."""

    def finish(self) -> Any:
        """Score the answers and write the result."""


Row = TypeVar("Row", bound=_Row)


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
         progress: Callable[[int, int, str], None] = lambda *_: None) -> Iterator[tuple[Row, str]]:
    """Make results side by side.

    Args:
        rows: what to make; their results must have different paths.
        processes: jobs that run at the same time, each with one thread unless the environment says otherwise.
        check: test each method's contract on mock objects first.
        fan: where the jobs run; a shard makes its share of the trainings and scores nothing.
        progress: called with (jobs done, of how many, what is going on).

    Yields:
        Each row when it is finished, with "" or the message of its failure; of a shard only failures.

    Raises:
        Interrupted: the user has stopped it; finished trainings are kept.
    """
    counted = itertools.count()  # all trainings, so that every shard counts alike whatever is finished
    reader, queue, left = Reader(), list[tuple[Row, Job]](), dict[Path, int]()
    with contextlib.ExitStack() as held:
        for row in rows:
            try:
                if fan.shard is None:
                    held.enter_context(own(row.path))
                held.enter_context(row.of)
                row.of.look(check=check)
                mine = [job for job in row.of.jobs if fan.shard is None or next(counted) % fan.shard[1] == fan.shard[0]]
                jobs = [job for job in row.of.left if job in mine]
                if not fan.ray:
                    progress(0, len(jobs), f"{row.path.stem}: reading its dataset")
                    row.of.read(jobs, reader)
            except VsfsimError as error:
                yield row, str(error)
                continue
            queue += [(row, job) for job in jobs]
            left[row.path] = len(jobs)
            if not jobs and fan.shard is None:
                yield row, _finished(row)
        made = _by_ray(queue, fan) if fan.ray else _by_threads(queue, processes, reader)
        for done, (number, message) in enumerate(made, start=1):
            row, job = queue[number]
            progress(done, len(queue), f"{row.path.stem} {job.name}")
            left[row.path] -= 1
            if message and left[row.path] >= 0:
                left[row.path] = -1  # the first failure is told, and nothing after it
                yield row, message
            elif left[row.path] == 0 and fan.shard is None:
                yield row, _finished(row)


def _finished(row: Row) -> str:
    try:
        row.finish()
    except VsfsimError as error:
        return str(error)
    return ""


def _by_threads(queue: Sequence[tuple[Row, Job]], processes: int, reader: Reader) -> Iterator[tuple[int, str]]:
    """The number of each job in ``queue`` as it ends, with "" or what went wrong."""
    gpus, failed = _Gpus(), set[Path]()

    def work(row: Row, job: Job) -> str:
        if row.path in failed:
            return "not made"
        with gpus.one(row.of.parameters.get("device") == "cuda") as given:
            try:
                row.of.make(job, reader, environment=given)
            except VsfsimError as error:
                failed.add(row.path)
                return str(error)
        return ""

    with ThreadPoolExecutor(processes) as pool:
        numbers = {pool.submit(work, row, job): number for number, (row, job) in enumerate(queue)}
        try:
            for ready in as_completed(numbers):
                yield numbers[ready], ready.result()
        except (KeyboardInterrupt, GeneratorExit) as stop:
            pool.shutdown(wait=False, cancel_futures=True)
            for row, _ in queue:
                row.of.stop()
            if isinstance(stop, GeneratorExit):
                raise
            raise Interrupted("interrupted; finished trainings are kept. Run the same command again to go "
                              "on.") from None


def _by_ray(queue: Sequence[tuple[Row, Job]], fan: Fan) -> Iterator[tuple[int, str]]:
    """As `_by_threads`, on a cluster; a path must mean the same there."""
    items = [(replace(row.of, dataset=replace(row.of.dataset, path=row.of.dataset.path.absolute())), job)
             for row, job in queue]
    yield from engines.on_ray(_train, items, address=fan.ray, gpus=fan.gpus)


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
