"""Evaluations whose trainings run side by side: every training of every evaluation is a job in a process of its own.

A job keeps its answers in a folder beside the result, and the last job of an evaluation scores them all. A second call
with the same operands makes only what is missing. Where a method's ``device`` is "cuda", without a number, each of its
trainings is shown one GPU, that with the fewest of them. Instead of processes of this machine, a Ray cluster or the
shards of a job array may run the jobs (`vsfsim.core.engines.shard`), over a folder that their machines share.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from vsfsim.bench.commands.own_result import own
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.isolation.process import MethodProcess
from vsfsim.bench.method import contents_of
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Reader
from vsfsim.bench.trials.collect import Collector, Stage, stages
from vsfsim.bench.trials.training import Training
from vsfsim.core.engines import ray_cluster
from vsfsim.core.engines.shard import HERE, Fan
from vsfsim.core.errors import Interrupted, VsfsimError
from vsfsim.data.dataset import Dataset

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Evaluation:
    """One method on one task, to be made."""

    path: Path
    """Result file."""
    method: str
    """Name of an installed method, or module:attribute."""
    task: Task
    """The task."""
    dataset: Dataset
    """Its dataset."""
    finish: Callable[[], Any]
    """Scores the kept answers and writes the result."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Of the method's constructor, over its defaults."""
    seeds: int | None = None
    """Draws of the support set, None for the task's own number; with cross-validation, of one training."""
    training: Training = field(default_factory=Training)
    """What the method learns from."""
    isolation: Isolation = field(default_factory=Isolation)
    """How the method is run."""

    @property
    def parts(self) -> Path:
        """Folder of the answers of its jobs, beside the result."""
        return self.path.with_suffix(".parts")

    def stage_names(self, *, seeded: bool) -> list[str]:
        """Of all its trainings.

        Args:
            seeded: the method takes a ``seed``.

        Raises:
            TaskError: the dataset does not fit the task or the training.
        """
        return list(dict.fromkeys(s.name for s in self._stages(seeded=seeded)))

    @property
    def on_any_gpu(self) -> bool:
        """Whether each training may have another GPU."""
        return self.parameters.get("device") == "cuda"

    def _stages(self, *, seeded: bool) -> tuple[Stage, ...]:
        protocol = self.task.protocol
        runs = protocol.runs(seeded=seeded) if self.seeds is None else tuple(range(self.seeds))
        return tuple(stages(protocol, self.training.folds(self.dataset, protocol), runs, seeded=seeded))

    def read_stages(self, names: Sequence[str], read: Reader, *, seeded: bool, processes: int = 1) -> None:
        """Read in advance what some trainings and their trials need.

        Args:
            names: of the trainings. read: what reads. seeded: the method takes a ``seed``. processes: that read at the
            same time.

        Raises:
            TaskError: the dataset does not hold what the task reads.
        """
        found = [stage for stage in self._stages(seeded=seeded) if stage.name in names]
        # a smaller share of the training objects is drawn for each training by itself
        train = [name for stage in found for name in stage.train] if self.training.objects == 1.0 else []
        read.read(self.task, self.dataset, test=[name for stage in found for name in stage.test], train=train,
                  processes=processes)

    def make_stage(self, name: str, read: Reader) -> None:
        """One training and its trials; the answers go into `parts`.

        Args:
            name: of the training. read: what reads the object views, or has read them.
        """
        Collector(self.method, dict(self.parameters), self.task, self.dataset, self.seeds, self.isolation,
                  self.parts / f"{name}.log", self.parts / name, lambda *_: None, False, self.training, name,
                  read).run()


@dataclass
class _Job:
    """One process's work."""

    of: Evaluation
    stage: str | None
    """None for the last one, which scores."""
    gpu: str = ""
    """The only one that it sees, as CUDA_VISIBLE_DEVICES names it; "" for what its parent sees."""


def make(evaluations: Sequence[Evaluation], processes: int, *, check: bool = True, fan: Fan = HERE,
         progress: Callable[[int, int, str], None] = lambda *_: None) -> Iterator[tuple[Evaluation, str]]:
    """Make results side by side.

    Args:
        evaluations: what to make; their results must have different paths.
        processes: jobs that run at the same time, each with one thread unless the environment says otherwise.
        check: test each method's contract on mock objects first.
        fan: where the jobs run; a shard makes its share of the trainings and scores nothing.
        progress: called with (jobs done, of how many, what is going on).

    Yields:
        Each evaluation when it is finished, with "" or the message of its failure; of a shard only failures.

    Raises:
        Interrupted: the user has stopped it; finished trainings are kept.
    """
    with contextlib.ExitStack() as held:
        yield from _make(evaluations, processes, check, fan, progress, held)


def _make(evaluations: Sequence[Evaluation], processes: int, check: bool, fan: Fan,
          progress: Callable[[int, int, str], None], held: contextlib.ExitStack) -> Iterator[tuple[Evaluation, str]]:
    counted = itertools.count()  # all trainings, so that every shard counts alike whatever is finished
    queue: list[_Job] = []
    read = Reader()  # before the jobs are forked, so that they share what it has read
    left: dict[Path, int] = {}
    seeded: dict[str, bool] = {}
    for one in evaluations:
        try:
            if fan.shard is None:
                held.enter_context(own(one.path))
            if one.method not in seeded or check:
                seeded[one.method] = _looked_at(one, check)
            names = [n for n in one.stage_names(seeded=seeded[one.method]) if _is_mine(next(counted), fan.shard)
                     and not (one.parts / n / f"{n}.npz").is_file()
                     and not (one.path.with_suffix(".part") / f"{n}.npz").is_file()]
            if len(names) > 1 and not fan.ray:
                progress(0, len(names), f"{one.path.stem}: reading its dataset")
                one.read_stages(names, read, seeded=seeded[one.method], processes=processes)
        except VsfsimError as error:
            yield one, str(error)
            continue
        queue += [_Job(one, name) for name in names]
        if fan.shard is None:
            left[one.path] = len(names)
            queue += [] if names else [_Job(one, None)]
    if fan.ray:
        yield from _by_ray(queue, left, fan, progress)
    else:
        yield from _run(queue, left, processes, progress, read)


def _is_mine(number: int, shard: tuple[int, int] | None) -> bool:
    return shard is None or number % shard[1] == shard[0]


def _by_ray(queue: Sequence[_Job], left: dict[Path, int], fan: Fan,
            progress: Callable[[int, int, str], None]) -> Iterator[tuple[Evaluation, str]]:
    """The trainings on a cluster, the scores here."""
    jobs = [job for job in queue if job.stage is not None]
    ready = [job.of for job in queue if job.stage is None]
    failed: set[Path] = set()

    def scored(one: Evaluation) -> tuple[Evaluation, str]:
        try:
            one.finish()
        except VsfsimError as error:
            return one, str(error)
        return one, ""

    yield from map(scored, ready)
    # the last job's function may hold what cannot be sent, and a path must mean the same there
    items = [(replace(job.of, path=job.of.path.absolute(), finish=_nothing,
                      dataset=replace(job.of.dataset, path=job.of.dataset.path.absolute())), job.stage) for job in jobs]
    for done, (number, message) in enumerate(ray_cluster.run(_train, items, address=fan.ray, gpus=fan.gpus), start=1):
        one, stage = jobs[number].of, jobs[number].stage
        progress(done, len(jobs), f"{one.path.stem} {stage}")
        left[one.path] -= 1
        if message and one.path not in failed:
            failed.add(one.path)
            yield one, message
        elif left[one.path] == 0 and one.path not in failed:
            yield scored(one)


def _train(item: tuple[Evaluation, str]) -> None:
    """In a task of a cluster: one training and its trials."""
    one, stage = item
    one.parts.mkdir(parents=True, exist_ok=True)
    one.make_stage(stage, Reader())


def _nothing() -> None:
    pass


def _looked_at(one: Evaluation, check: bool) -> bool:
    """Whether the method takes a ``seed``.

    Raises:
        MethodError: it is unknown, or breaks its contract.
    """
    one.parts.mkdir(parents=True, exist_ok=True)
    with MethodProcess(one.method, one.parameters, one.isolation, one.parts / "check.log") as process:
        if check:
            process.require()
        # The source of the harness is parsed here, once, and not in every job, which are forks of this process.
        contents_of(one.method, process.description.parameters)
        return process.description.seeded


def _run(queue: list[_Job], left: dict[Path, int], processes: int, progress: Callable[[int, int, str], None],
         read: Reader) -> Iterator[tuple[Evaluation, str]]:
    context = multiprocessing.get_context("fork")
    running: dict[Connection, tuple[_Job, BaseProcess]] = {}
    failed: set[Path] = set()
    gpus = _gpus()
    total, done = len(queue) + sum(n > 0 for n in left.values()), 0  # a shard scores nothing, and `left` is empty
    try:
        while queue or running:
            while queue and len(running) < processes:
                job = queue.pop(0)
                if job.of.path in failed:
                    done += 1
                    continue
                if job.of.on_any_gpu and job.stage is not None:
                    job.gpu = _freest(gpus, [j.gpu for j, _ in running.values()])
                mine, theirs = context.Pipe(duplex=False)
                child: BaseProcess = context.Process(target=_work, args=(job, theirs, read))
                child.start()
                theirs.close()
                running[mine] = job, child
            if not running:  # what was left was of evaluations that have failed
                break
            for ready in wait(list(running)):
                assert isinstance(ready, Connection)
                job, child = running.pop(ready)
                try:
                    message = ready.recv()
                except EOFError:
                    message = f"a process of {job.of.path.name} ended without a word (exit code {child.exitcode})."
                ready.close()
                child.join()
                done += 1
                progress(done, total, f"{job.of.path.stem} {job.stage or 'scored'}")
                if job.of.path in left:
                    left[job.of.path] -= job.stage is not None
                if job.of.path in failed:
                    continue
                if message or job.stage is None:
                    failed |= {job.of.path} if message else set()
                    yield job.of, message
                elif left.get(job.of.path) == 0:
                    queue.insert(0, _Job(job.of, None))
    except KeyboardInterrupt:
        raise Interrupted("interrupted; finished trainings are kept. Run the same command again to go on.") from None
    finally:
        for _, child in running.values():
            child.terminate()
        for _, child in running.values():
            child.join()


def _gpus() -> list[str]:
    """What CUDA_VISIBLE_DEVICES may name here, without starting a driver: what is started before a fork is of no use
    after it."""
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    if shown is not None:
        return [name.strip() for name in shown.split(",") if name.strip()]
    return [str(k) for k in range(len(list(Path("/dev").glob("nvidia[0-9]*"))))]


def _freest(gpus: Sequence[str], taken: Sequence[str]) -> str:
    """The GPU that is taken least often, the first of several; "" where there is none."""
    return min(gpus, key=taken.count, default="")


def _work(job: _Job, answer: Connection, read: Reader) -> None:
    """In the child: do the job and send "" or what went wrong. ``read`` is the parent's, with what it has read."""
    for name in _THREADS:
        os.environ.setdefault(name, "1")  # of the method's process, which begins after this
    if job.gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = job.gpu
    with contextlib.suppress(KeyboardInterrupt, BrokenPipeError):
        try:
            if job.stage is None:
                job.of.finish()
            else:
                job.of.parts.mkdir(parents=True, exist_ok=True)
                job.of.make_stage(job.stage, read)
            answer.send("")
        except VsfsimError as error:
            answer.send(str(error))
    answer.close()
