"""Many views of plants at once: prepared and finished by CPU processes, while those that are ready are touched together
on one device.

A GPU's warp carries out one touch, so the touches of one view alone would leave it idle: views come in as they are
prepared and go out as they are done. The bits of a touch do not depend on which others it is solved with.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Any

import numpy as np

from vsfsim.data.hdf5 import write_view
from vsfsim.data.records import ObjectView, View
from vsfsim.generate.effectors.arm import Seconds, Subject, begin, choose, finish, look, outline, rod_options
from vsfsim.generate.plants.aim import ArmAim, load
from vsfsim.physics.rods.solver import GPU_SPAN, RodBatch, RodFrames, RodSolver

PLACES = 4096  # touches on a device at once: 7 GB
SHORT_SPAN = 3.0  # s: a launch on a GPU while touches are still to come
# touches of a view that a process chooses at a time: the first ones are touched soon, and where most targets are out of
# reach no process is held up for long
PART = 17


@contextlib.contextmanager
def crew(jobs: int, workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """Processes of one thread each, ``workers`` of them (None: one for every core), and no more than ``jobs``."""
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    pool = ProcessPoolExecutor(max(1, min(workers or os.cpu_count() or 1, jobs)),
                               mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


class _Preparation:
    """Views on their way to be touched: each is looked at by one process, and then aimed at by several, `PART` touches
    at a time.

    outlines: of the views. ready: parts that can be touched: number of the view, of the part, and these touches of the
    view.
    """

    def __init__(self, jobs: Sequence[Any], pool: ProcessPoolExecutor, device: str, spent: Seconds):
        self._jobs, self._pool, self._spent = jobs, pool, spent
        self._looking: dict[Future[tuple[View, np.ndarray, Seconds]],
                            int] = {pool.submit(look_one, job, device): k for k, job in enumerate(jobs)}
        self._aiming: dict[Future[tuple[list[ArmAim], np.ndarray, Seconds]], tuple[int, int]] = {}
        self._views: dict[int, View] = {}
        # while the processes begin
        since = spent.begin()
        self.outlines = [outline(job) for job in jobs]
        spent.charge("grow", since)
        self.ready: list[tuple[int, int, Subject]] = []

    @property
    def going(self) -> bool:
        """Whether parts are still to come."""
        return bool(self._looking or self._aiming)

    def parts(self, k: int) -> int:
        """How many parts view ``k`` has."""
        return -(-self.outlines[k].touches.count // PART)

    def gather(self, timeout: float) -> int:
        """Waits ``timeout`` [s] at most for something new; how many touches are newly ready."""
        there, _ = wait([*self._looking, *self._aiming], timeout=timeout, return_when=FIRST_COMPLETED)
        before = len(self.ready)
        for future in there:
            if future in self._looking:
                k = self._looking.pop(future)
                self._views[k], cloud, took = future.result()
                count = self.outlines[k].touches.count
                for part in range(self.parts(k)):
                    self._aiming[self._pool.submit(aim_one, self._jobs[k], cloud,
                                                   range(part * PART, min((part + 1) * PART, count)))] = k, part
            else:
                k, part = self._aiming.pop(future)
                aims, poses, took = future.result()
                o, job = self.outlines[k], self._jobs[k]
                self.ready.append((k, part, Subject(job.name, job.split, (job.object_index, job.view_index), o.scene,
                                                    o.plant, o.model, self._views[k], None, aims, poses)))
            add(self._spent, took)
        return sum(len(s.aims) for *_, s in self.ready[before:])

    def cancel(self) -> None:
        """No more parts are wanted."""
        for future in (*self._looking, *self._aiming):
            future.cancel()


def touched(jobs: Sequence[Any], pool: ProcessPoolExecutor, *, device: str, spent: Seconds, until: float | None = None,
            watch: Callable[[str, int, int], None] | None = None) -> Iterator[tuple[int, Subject, RodFrames]]:
    """Number, subject and frames of the views of ``jobs`` (`generate.run.Job`), in the order in which they are done.

    Args:
        pool: processes that prepare. spent: where the time of all processes is charged. until: on the clock
        (`time.perf_counter`) when no launch is begun any more; touches under way then come as far as they are, others
        not at all.
        watch: called with what happened, "prepared" or "solved", how many touches or frames newly did, and touches that
        go on.
    """
    coming = _Preparation(jobs, pool, device, spent)
    since = spent.begin()
    first = coming.outlines[0]
    assert first.scene.arm is not None
    free, inward, hold, out = first.touches.frames
    solver = RodSolver([o.model for o in coming.outlines], load(first.scene.arm).shapes, device=device,
                       options=rod_options(first.scene))
    batch = RodBatch(solver, min(max(PLACES, PART), sum(o.touches.count for o in coming.outlines)),
                     frames=free + inward + hold + out, poses=inward + 1)
    spent.charge("solve", since)
    inside: dict[tuple[int, int], tuple[Subject, slice]] = {}
    done: dict[int, dict[int, tuple[Subject, RodFrames]]] = {}
    while coming.going or coming.ready or inside:
        left = np.inf if until is None else until - time.perf_counter()
        if left <= 0.0:
            break
        new = coming.gather(0.0 if batch.live else min(left, 2.0))
        if new and watch is not None:
            watch("prepared", new, batch.live)
        since = spent.begin()
        while coming.ready and batch.room(len(coming.ready[0][2].aims)):
            k, part, subject = coming.ready.pop(0)
            inside[k, part] = _lean(subject), begin(batch, subject, k)
        if batch.live:
            new = batch.advance(seconds=min(SHORT_SPAN if coming.going or coming.ready else GPU_SPAN, left))
            if watch is not None:
                watch("solved", new, batch.live)
        for k, part in [key for key, (_, some) in inside.items() if batch.done(some)]:
            subject, some = inside.pop((k, part))
            done.setdefault(k, {})[part] = subject, batch.take(some)
        spent.charge("solve", since)
        for k in [k for k, parts in done.items() if len(parts) == coming.parts(k)]:
            yield k, *_joined(done.pop(k))
    coming.cancel()
    for (k, part), (subject, some) in inside.items():
        done.setdefault(k, {})[part] = subject, batch.take(some)
    for k, parts in done.items():
        yield k, *_joined(parts)


def _joined(parts: dict[int, tuple[Subject, RodFrames]]) -> tuple[Subject, RodFrames]:
    """A view of its parts."""
    subjects, frames = zip(*(parts[number] for number in sorted(parts)), strict=True)
    return dataclasses.replace(subjects[0], aims=[a for s in subjects for a in s.aims]), RodFrames.joined(frames)


def _lean(subject: Subject) -> Subject:
    """Without what is not needed any more when it travels."""
    return dataclasses.replace(subject, arm=None, poses=np.zeros((0, 0, 0, 4, 4)))


def make_all(jobs: Sequence[Any], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
    """Makes and writes the views of ``jobs`` (`generate.run.Job`); yields the number of frames newly done and a name.

    Args:
        device: Warp device, of the processes too. workers: processes, None for one a core.
    """
    with crew(len(jobs), workers) as pool:
        writing: list[Future[None]] = []
        for k, subject, frames in touched(jobs, pool, device=device, spent=Seconds()):
            writing.append(pool.submit(_write, jobs[k], subject, frames, device))
            yield sum(len(a.plan) for a in subject.aims), jobs[k].name
        for future in writing:
            future.result()


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def look_one(job: Any, device: str) -> tuple[View, np.ndarray, Seconds]:
    """In a process of its own: the picture of a view, its cloud (n, 3) [m], and where the time went."""
    seconds = Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    view = look(o, job, device=device, seconds=seconds)
    return view, view.points(), seconds


def aim_one(job: Any, cloud: np.ndarray, numbers: range) -> tuple[list[ArmAim], np.ndarray, Seconds]:
    """In a process of its own: some touches of a view, the poses along their lines, and where the time went. The arm
    holds a simulator, which does not travel."""
    seconds = Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    _, aims, poses = choose(o, cloud, numbers, seconds=seconds)
    return aims, poses, seconds


def finish_one(subject: Subject, frames: RodFrames, device: str) -> tuple[ObjectView, Seconds]:
    """In a process of its own: the records of a touched view, and where the time went."""
    seconds = Seconds()
    return finish(subject, frames, device=device, seconds=seconds), seconds


def add(spent: Seconds, took: Seconds) -> None:
    """Adds the time of another process."""
    spent.spent.update(took.spent)
    spent.cpu.update(took.cpu)


def _write(job: Any, subject: Subject, frames: RodFrames, device: str) -> None:
    write_view(job.file, finish(subject, frames, device=device))
