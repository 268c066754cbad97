"""The resident memory of this process, as Linux counts it. The peak can be reset, so that the peak of a method does not
include what was loaded before."""

from __future__ import annotations

import contextlib
from pathlib import Path


def held_memory(*, reset: bool = False) -> float:
    """Resident memory now [MiB]. ``reset`` resets the peak, where the kernel allows it; elsewhere the peak stays that
    since the start."""
    if reset:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def peak_memory() -> float:
    """Peak of the resident memory since the last reset [MiB]."""
    return _status("VmHWM")


def _status(key: str) -> float:
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{key}:")]
    return float(line.split()[1]) / 1024.0
