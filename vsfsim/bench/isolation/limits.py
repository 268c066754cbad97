"""What the operating system enforces on a method's process: memory, file sizes, and an end with its parent."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from vsfsim.bench.isolation import container
from vsfsim.core.errors import MethodError

GIB = 1 << 30
LARGEST_FILE = 8 * GIB
"""A method may write no larger file [bytes]."""
VARIABLE = "VSFSIM_SANDBOX"
"""Environment variable that names the sandbox where none is asked for."""
LARGEST_LOG = 64 << 20
"""A method may print no more in one evaluation [bytes]."""


@dataclass(frozen=True)
class Isolation:
    """How a method is kept from what it may not see."""

    sandbox: str = ""
    """One of `container.SANDBOXES`: "bubblewrap" and "namespaces" are containers that show it no file of the user's and
    no network, "process" is a process of its own; "" becomes what `VARIABLE` says, or the strongest one that
    works here."""
    timeout: float | None = None
    """Seconds that one call of the method may take, None for no limit."""
    memory: float | None = None
    """Memory that each of its processes may allocate [GiB], None for no limit."""
    workers: int = 1
    """Trials that run at the same time."""

    def __post_init__(self) -> None:
        if self.sandbox == "":
            object.__setattr__(self, "sandbox", os.environ.get(VARIABLE) or container.strongest())
        if self.sandbox not in container.SANDBOXES:
            raise MethodError(f"--sandbox is '{self.sandbox}'. Allowed: {', '.join(container.SANDBOXES)}.")
        container.require(self.sandbox)
        for name, value in (("--timeout", self.timeout), ("--memory", self.memory)):
            if value is not None and not 0.0 < value < 1e9:
                raise MethodError(f"{name} is {value}; it must be greater than 0.")
        if self.workers < 1:
            raise MethodError(f"--workers is {self.workers}; it must be at least 1.")


def apply(memory: float | None) -> None:
    """Lower this process's limits for good; processes that it starts inherit them.

    Memory is RLIMIT_DATA on Linux, which counts what was allocated and not address space that a GPU driver only
    reserves, and RLIMIT_AS elsewhere. Nothing happens on a system without `resource`.

    Args:
        memory: most memory [GiB], or None.
    """
    try:
        import resource
    except ImportError:
        return
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: LARGEST_FILE}
    if memory is not None:
        limits[resource.RLIMIT_DATA if sys.platform == "linux" else resource.RLIMIT_AS] = int(memory * GIB)
    for kind, value in limits.items():
        hard = resource.getrlimit(kind)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (value, value))


def end_with_parent() -> None:
    """Have the kernel kill this process when its parent ends (Linux); elsewhere it ends when its pipe closes."""
    if sys.platform != "linux":
        return
    parent = os.getppid()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGKILL, 0, 0, 0)  # 1: PR_SET_PDEATHSIG
    if os.getppid() != parent:
        os._exit(1)  # the parent ended before the kernel knew


def peak_memory_mib(of_children: bool = False) -> float:
    """Largest resident size so far of this process, or of those that it has started [MiB]; 0 where the system does not
    report it."""
    try:
        import resource
    except ImportError:
        return 0.0
    peak = resource.getrusage(resource.RUSAGE_CHILDREN if of_children else resource.RUSAGE_SELF).ru_maxrss
    return peak / 1024.0 if sys.platform == "linux" else peak / 1024.0**2


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """The environment of the process: the scorer's, without the folder of the datasets."""
    return {key: value for key, value in given.items() if key not in ("VSFSIM_DATASETS", "OLDPWD", "PWD")}
