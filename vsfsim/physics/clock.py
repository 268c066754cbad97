"""The clock of a frame's limit; and where the solver's time goes, switched on by `vsfsim measure solver`."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_running = False
_spent: dict[str, list[float]] = defaultdict(lambda: [0, 0.0])


def now() -> float:
    """Processor time of this process [s], by which the limit of a frame is measured: what else runs on the machine does
    not decide which frames are marked. A thread that waits for the GPU counts, since it waits actively."""
    return time.process_time()


def running() -> bool:
    """Whether time is being counted; then nothing may be captured as a graph, since the clock waits for the GPU."""
    return _running


@contextmanager
def measure(part: str) -> Iterator[None]:
    """Count the time of a block under ``part``; waits for the GPU before and after, so only while the clock runs."""
    if not _running:
        yield
        return
    _wait()
    began = time.perf_counter()
    yield
    _wait()
    entry = _spent[part]
    entry[0] += 1
    entry[1] += time.perf_counter() - began


def start() -> None:
    """Begin to count, from zero."""
    global _running
    _spent.clear()
    _running = True


def stop() -> dict[str, tuple[int, float]]:
    """Stop; returns calls and seconds of every part."""
    global _running
    _running = False
    return {part: (int(calls), seconds) for part, (calls, seconds) in _spent.items()}


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
