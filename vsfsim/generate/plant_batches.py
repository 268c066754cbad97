"""Many views of plants at once: prepared and finished by CPU processes, while those that are ready are touched together on one device.

A GPU's warp carries out one touch, so the touches of one view alone would leave it idle: views come in as they are prepared and go out as they are done. The bits of a touch do not depend on which others it is solved with.
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
from vsfsim.data.records import ObjectView
from vsfsim.generate.plant_aim import load
from vsfsim.generate.plants import Seconds, Subject, begin, finish, outline, prepare_job, rod_options
from vsfsim.physics.rods.solver import GPU_SPAN, RodBatch, RodFrames, RodSolver

PLACES = 4096  # touches on a device at once: 7 GB
SHORT_SPAN = 3.0  # s: a launch on a GPU while views are still to come


@contextlib.contextmanager
def crew(jobs: int, workers: int | None) -> Iterator[ProcessPoolExecutor]:
    """Processes of one thread each, ``workers`` of them (None: one for every core), and no more than ``jobs``."""
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    pool = ProcessPoolExecutor(max(1, min(workers or os.cpu_count() or 1, jobs)), mp_context=multiprocessing.get_context("spawn"))
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def touched(jobs: Sequence[Any], pool: ProcessPoolExecutor, *, device: str, spent: Seconds, until: float | None = None, watch: Callable[[str, int, int], None] | None = None) -> Iterator[tuple[int, Subject, RodFrames]]:
    """Number, subject and frames of the views of ``jobs`` (`generate.run.Job`), in the order in which they are done.

    Args:
        pool: processes that prepare. spent: where the time of all processes is charged. until: on the clock (`time.perf_counter`) when no launch is begun any more; views under way then come as far as they are, others not at all.
        watch: called with what happened, "prepared" or "solved", how many views or frames newly did, and touches that go on.
    """
    coming = {pool.submit(prepare_one, job, device): k for k, job in enumerate(jobs)}
    since = spent.begin()
    outlines = [outline(job) for job in jobs]
    scene = outlines[0].scene
    assert scene.arm is not None
    free, inward, hold, out = outlines[0].touches.frames
    solver = RodSolver([o.model for o in outlines], load(scene.arm).shapes, device=device, options=rod_options(scene))
    batch = RodBatch(solver, max(min(PLACES, sum(o.touches.count for o in outlines)), outlines[0].touches.count), frames=free + inward + hold + out, poses=inward + 1)
    spent.charge("grow", since)
    ready: list[tuple[int, Subject]] = []
    inside: dict[int, tuple[Subject, slice]] = {}
    while coming or ready or inside:
        left = np.inf if until is None else until - time.perf_counter()
        if left <= 0.0:
            break
        there, _ = wait(coming, timeout=0.0 if batch.live else min(left, 2.0), return_when=FIRST_COMPLETED)
        for future in there:
            subject, took = future.result()
            add(spent, took)
            ready.append((coming.pop(future), subject))
        if there and watch is not None:
            watch("prepared", len(there), batch.live)
        since = spent.begin()
        while ready and batch.room(len(ready[0][1].aims)):
            k, subject = ready.pop(0)
            inside[k] = subject, begin(batch, subject, k)
        if batch.live:
            new = batch.advance(seconds=min(SHORT_SPAN if coming or ready else GPU_SPAN, left))
            if watch is not None:
                watch("solved", new, batch.live)
        for k in [k for k, (_, some) in inside.items() if batch.done(some)]:
            subject, some = inside.pop(k)
            frames = batch.take(some)
            since = spent.charge("solve", since)
            yield k, _lean(subject), frames
            since = spent.begin()
        spent.charge("solve", since)
    for future in coming:
        future.cancel()
    for k, (subject, some) in inside.items():
        yield k, _lean(subject), batch.take(some)


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


def prepare_one(job: Any, device: str) -> tuple[Subject, Seconds]:
    """In a process of its own: a view ready to be touched, and where the time went."""
    seconds = Seconds()
    return dataclasses.replace(prepare_job(job, device=device, seconds=seconds), arm=None), seconds  # an arm holds a simulator, which does not travel


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
