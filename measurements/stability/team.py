"""Jobs in worker processes that may crash or not end."""

from __future__ import annotations

import contextlib
import multiprocessing as mp
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import Queue
from typing import Any

from vsfsim.core.system.engines import one_thread

_STARTS = threading.Lock()
"""Of processes, whose environment is that of this one."""


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


@contextlib.contextmanager
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


def answers(jobs: Sequence[Any], work: Callable[[Any], Any], *, workers: int, most: float,
            budget: float | None = None) -> Iterator[tuple[Any, Any]]:
    """Each job with what ``work`` makes of it, or an `Ended`, as they are done.

    Args:
        jobs: in the order in which they begin.
        work: a function of a module, since processes are spawned.
        workers: processes.
        most: wall time after which a job is ended [s].
        budget: time after which no job begins [s]; None for none.
    """
    until = time.perf_counter() + (float("inf") if budget is None else budget)
    # an iterator of a list gives each job to one thread
    waiting, done, working = iter(list(jobs)), Queue[tuple[Any, Any] | None](), min(workers, len(jobs))
    for _ in range(working):
        threading.Thread(target=_lane, args=(waiting, done, work, most, until), daemon=True).start()
    try:
        while working:
            if (found := done.get()) is None:
                working -= 1
            else:
                yield found
    finally:
        list(waiting)  # so that the threads end


def _lane(waiting: Iterator[Any], done: Queue[Any], work: Callable[[Any], Any], most: float, until: float) -> None:
    """In a thread: one job after another in a process, a new one where the last one ended."""
    context, process = mp.get_context("spawn"), None
    for job in waiting:
        if time.perf_counter() > until:
            break
        if process is None:
            pipe, theirs = context.Pipe()
            process = context.Process(target=_serve, args=(theirs, work), daemon=True)
            with _STARTS, one_thread():  # and the processor time of a job is not that of threads that wait
                process.start()
            theirs.close()
        began = time.perf_counter()
        try:
            pipe.send(job)
            found = pipe.recv() if pipe.poll(most) else Ended(True, f"no answer within {most:.0f} s", most)
        except (EOFError, OSError):
            process.join()
            found = Ended(False, f"the process ended with code {process.exitcode}", time.perf_counter() - began)
        if isinstance(found, Ended):
            process.kill()
            process = None
        done.put((job, found))
    if process is not None:
        process.kill()
    done.put(None)


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(work(pipe.recv()))
