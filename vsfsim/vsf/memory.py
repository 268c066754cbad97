"""What this process holds, as Linux counts it: the peak can be begun anew, so that a method's is not that of what was
loaded before."""

from __future__ import annotations

import contextlib
from pathlib import Path


def held_memory(*, reset: bool = False) -> float:
    """What this process holds now [MiB]; ``reset`` begins the peak anew, where the kernel lets it (else the peak is
    that since the start)."""
    if reset:
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS")


def peak_memory() -> float:
    """The most it held since the peak was begun [MiB]."""
    return _status("VmHWM")


def _status(key: str) -> float:
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(f"{key}:")]
    return float(line.split()[1]) / 1024.0
