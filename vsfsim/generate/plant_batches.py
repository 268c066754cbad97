"""Plants on a GPU: views are prepared and finished by CPU processes, and the touches of many views are solved together.

A GPU thread carries out one touch, so the touches of one view alone would leave it idle. The bits of a touch do not depend on which others it is solved with.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any

from vsfsim.data.hdf5 import write_view
from vsfsim.generate.plants import Subject, finish, prepare_job, solve

GROUP = 16  # views that are solved together: about a thousand touches


def make_all(jobs: Sequence[Any], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
    """Makes and writes the views of ``jobs`` (`generate.run.Job`); yields the number of frames newly done and a name.

    Args:
        device: Warp device of the solver; pictures and particles are made on the CPU. workers: processes, None for one a core.
    """
    context = multiprocessing.get_context("spawn")
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with ProcessPoolExecutor(min(workers or os.cpu_count() or 1, len(jobs)), mp_context=context) as pool:
            prepared: list[Future[Subject]] = [pool.submit(_prepare, job) for job in jobs]
            writing: list[Future[None]] = []
            for begin in range(0, len(jobs), GROUP):
                some = jobs[begin:begin + GROUP]
                subjects = [future.result() for future in prepared[begin:begin + GROUP]]
                for job, subject, (frames, columns) in zip(some, subjects, solve(subjects, device=device), strict=True):
                    writing.append(pool.submit(_finish, job, subject, frames, columns))
                    yield sum(len(a.q) for a in subject.aims), job.name
            for future in writing:
                future.result()
    finally:
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _prepare(job: Any) -> Subject:
    return dataclasses.replace(prepare_job(job, device="cpu"), arm=None)  # an arm holds a simulator, which does not travel


def _finish(job: Any, subject: Subject, frames: Any, columns: slice) -> None:
    write_view(job.file, finish(subject, frames, columns, device="cpu"))
