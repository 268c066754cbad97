"""Processes: new ones of one thread each, and the peak of this one's resident memory, as Linux counts it."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of a process of one thread."""


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Processes that start in the block have one thread each, because a sum that is split over threads depends on how
    many there are."""
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name in ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)


def reset_peak_memory() -> None:
    """Let `peak_memory` begin anew, so that it does not include what was loaded before; where the kernel does not allow
    it, the peak stays that since the start."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory() -> float:
    """Peak of the resident memory since the last reset [MiB]."""
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM:")]
    return float(line.split()[1]) / 1024.0
