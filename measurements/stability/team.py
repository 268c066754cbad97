"""Jobs in worker processes that may crash or not end."""

from __future__ import annotations

import multiprocessing as mp
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

from vsfsim.core.system.engines import one_thread


@dataclass(frozen=True)
class Ended:
    """What a job has instead of an answer."""

    late: bool
    """It was ended because it took too long; else its process ended by itself."""
    words: str
    seconds: float
    """Wall time [s]."""


class Late(BaseException):
    """A block took more processor time than it may; no `except Exception` of the block catches it."""


@contextmanager
def processor_time(seconds: float) -> Iterator[None]:
    """Raise `Late` in the block once it has taken so much processor time; only in the main thread of a process."""
    def late(*_: object) -> None:
        raise Late

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, seconds, 1.0)  # again every second, should a callback from C swallow it
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@dataclass
class _Worker:
    process: mp.process.BaseProcess
    pipe: Connection
    job: Any = None
    since: float = 0.0


def answers(jobs: Sequence[Any], work: Callable[[Any], Any], *, workers: int, most: float,
            budget: float | None = None) -> Iterator[tuple[Any, Any]]:
    """Each job with what ``work`` makes of it, or an `Ended`, as they are done.

    Args:
        jobs: none of them None; in the order in which they begin.
        work: a function of a module, since processes are spawned.
        workers: processes.
        most: wall time after which a job is ended [s].
        budget: time after which no job begins [s]; None for none.
    """
    began, waiting = time.perf_counter(), list(jobs)[::-1]
    team = [_start(work) for _ in range(min(workers, len(waiting)))]
    try:
        while True:
            over = budget is not None and time.perf_counter() - began > budget
            for worker in team:
                if worker.job is None and waiting and not over:
                    worker.job, worker.since = waiting.pop(), time.perf_counter()
                    worker.pipe.send(worker.job)
            busy = [w for w in team if w.job is not None]
            if not busy:
                return
            ready = wait([w.pipe for w in busy], timeout=1.0)
            for k, worker in enumerate(team):
                found = None if worker.job is None else _answer(worker, worker.pipe in ready, most)
                if found is None:
                    continue
                job, worker.job = worker.job, None
                if not worker.process.is_alive():
                    team[k] = _start(work)
                yield job, found
    finally:
        for worker in team:
            worker.process.kill()


def _start(work: Callable[[Any], Any]) -> _Worker:
    context = mp.get_context("spawn")
    mine, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work), daemon=True)
    with one_thread():  # and the processor time of a job is not that of threads which wait for one another
        process.start()
    theirs.close()
    return _Worker(process, mine)


def _answer(worker: _Worker, ready: bool, most: float) -> Any:
    """Of a worker that has an answer, or that had to be ended; else None."""
    spent = time.perf_counter() - worker.since
    if ready:
        try:
            return worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            return Ended(False, f"the process ended with code {worker.process.exitcode}", spent)
    if spent > most:
        worker.process.kill()
        worker.process.join()
        return Ended(True, f"no answer within {spent:.0f} s", spent)
    return None


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(work(job))
