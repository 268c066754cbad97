"""Plants on a GPU: views are prepared and finished by CPU processes, and the touches of many views are solved together.

A GPU thread carries out one touch, so the touches of one view alone would leave it idle. The bits of a touch do not depend on which others it is solved with.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

from vsfsim.data.hdf5 import write_view
from vsfsim.data.records import ObjectView
from vsfsim.generate.plants import Seconds, Subject, finish, prepare_job, solve
from vsfsim.physics.rods.solver import RodFrames

GROUP = 24  # views that are solved together: some 1,600 touches, while the others are prepared


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


def make_all(jobs: Sequence[Any], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
    """Makes and writes the views of ``jobs`` (`generate.run.Job`); yields the number of frames newly done and a name.

    Args:
        device: Warp device, of the processes too. workers: processes, None for one a core.
    """
    with crew(len(jobs), workers) as pool:
        prepared = [pool.submit(prepare_one, job, device) for job in jobs]
        writing: list[Future[None]] = []
        for begin in range(0, len(jobs), GROUP):
            some = jobs[begin:begin + GROUP]
            subjects = [future.result()[0] for future in prepared[begin:begin + GROUP]]
            for job, subject, (frames, columns) in zip(some, subjects, solve(subjects, device=device), strict=True):
                writing.append(pool.submit(_write, job, subject, frames, columns, device))
                yield sum(len(a.q) for a in subject.aims), job.name
        for future in writing:
            future.result()


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def prepare_one(job: Any, device: str) -> tuple[Subject, Seconds]:
    """In a process of its own: a view ready to be touched, and where the time went."""
    seconds = Seconds()
    return dataclasses.replace(prepare_job(job, device=device, seconds=seconds), arm=None), seconds  # an arm holds a simulator, which does not travel


def finish_one(subject: Subject, frames: RodFrames, columns: slice, device: str) -> tuple[ObjectView, Seconds]:
    """In a process of its own: the records of a touched view, and where the time went."""
    seconds = Seconds()
    return finish(subject, frames, columns, device=device, seconds=seconds), seconds


def _write(job: Any, subject: Subject, frames: RodFrames, columns: slice, device: str) -> None:
    write_view(job.file, finish(subject, frames, columns, device=device))
