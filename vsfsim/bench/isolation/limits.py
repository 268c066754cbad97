"""How a method is kept from what it may not see, what the operating system enforces on its processes, and what a
container shows: the system's libraries, Python, installed packages, vsfsim's code, the method's source, GPUs, and the
files and folders that its parameters name."""

from __future__ import annotations

import contextlib
import functools
import glob
import os
import subprocess
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import vsfsim
from vsfsim.bench.identity import files_of, imports_of, packages_of
from vsfsim.bench.isolation import box
from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import folder
from vsfsim.core.system.content import named_files, named_folders

GIB = 1 << 30
SANDBOXES = ("namespaces", "process")
"""The strongest first: a container (`box`), and a process without one."""
VARIABLE = "VSFSIM_SANDBOX"
"""Environment variable that names the sandbox where none is asked for."""
LARGEST_LOG = 64 << 20
"""What a method prints beyond it in one evaluation is not kept [bytes]."""
LARGEST_FOLDER = 2 * GIB
"""A process may write no more into its folder in memory, nor a larger file [bytes]."""
_KEPT = ("PATH", "LANG", "TZ", "LD_LIBRARY_PATH", "VSFSIM_DINOV2", "TORCH_HOME", "HF_HOME")
_KEPT_PREFIXES = ("LC_", "OMP_", "MKL_", "OPENBLAS_", "KMP_", "GOMP_", "CUDA_", "NVIDIA_", "ATEN_", "NPY_", "NUMBA_")
"""Variables that a method's process has from the user's environment: threads, GPUs, rounding, weights."""


@dataclass(frozen=True)
class Isolation:
    """How a method is kept from what it may not see."""

    sandbox: str = ""
    """One of `SANDBOXES`: "namespaces" is a container that shows it no file of the user's and no network, "process" is
    a process without one; "" becomes what `VARIABLE` says, or the strongest one that works here."""
    timeout: float | None = None
    """Seconds that one call of the method may take, None for no limit."""
    memory: float | None = None
    """Memory that each of its processes may allocate [GiB], None for what the machine has."""

    def __post_init__(self) -> None:
        if self.sandbox == "":
            object.__setattr__(self, "sandbox", os.environ.get(VARIABLE) or strongest())
        if self.sandbox not in SANDBOXES:
            raise MethodError(f"--sandbox is '{self.sandbox}'. Allowed: {', '.join(SANDBOXES)}.")
        if not works(self.sandbox):
            raise MethodError(f"--sandbox {self.sandbox} does not work here: it needs Linux 5.12 or later and the "
                              f"right to make namespaces. Leave --sandbox away for the strongest "
                              f"one that works: {strongest()}.")
        for name, value in (("--timeout", self.timeout), ("--memory", self.memory)):
            if value is not None and not 0.0 < value < 1e9:
                raise MethodError(f"{name} is {value}; it must be greater than 0.")


def strongest() -> str:
    """The first of `SANDBOXES` that works here."""
    return next(name for name in SANDBOXES if works(name))


@functools.cache
def works(sandbox: str) -> bool:
    """Whether a sandbox works here; it is tried."""
    if sandbox == "process":
        return True
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return sys.platform == "linux" and subprocess.run(
            [sys.executable, "-I", "-S", box.__file__], capture_output=True, timeout=20.0).returncode == 0
    return False


def apply(memory: float | None, contained: bool) -> None:
    """Lower this process's limits for good; processes that it starts inherit them.

    Memory is RLIMIT_DATA on Linux, which counts what was allocated and not address space that a GPU driver only
    reserves, and RLIMIT_AS elsewhere. The number of processes counts in a container, where they are a user's of their
    own.

    Args:
        memory: most memory [GiB], None for what the machine has. contained: it runs in a container.
    """
    import resource

    size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if memory is None else int(memory * GIB)
    limits = {resource.RLIMIT_CORE: 0, resource.RLIMIT_FSIZE: LARGEST_FOLDER,
              resource.RLIMIT_DATA if sys.platform == "linux" else resource.RLIMIT_AS: size,
              **({resource.RLIMIT_NPROC: 512 + 32 * (os.cpu_count() or 1)} if contained else {})}
    for kind, value in limits.items():
        hard = resource.getrlimit(kind)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(kind, (value, value))


def environment(given: Mapping[str, str]) -> dict[str, str]:
    """What of the scorer's environment a method's process has, and where it finds weights."""
    cache = given.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    weights = {"TORCH_HOME": os.path.join(cache, "torch"), "HF_HOME": os.path.join(cache, "huggingface")}
    return weights | {key: value for key, value in given.items() if key in _KEPT or key.startswith(_KEPT_PREFIXES)}


_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc", "/opt", "/nix", "/gnu", "/sys")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/nvidia*",
            "/dev/dri", "/dev/kfd", "/dev/dxg")


def kernels() -> str:
    """The user's folder of compiled kernels."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return os.path.realpath(os.environ.get("WARP_CACHE_PATH") or os.path.join(cache, "warp"))


def places(name: str, parameters: Mapping[str, Any], *, search: Iterable[str],
           hidden: Iterable[Path], given: Mapping[str, str]) -> dict[str, Any]:
    """The operand of `vsfsim.bench.isolation.box.enter`, without its root and the size of its folder.

    Args:
        name, parameters: of the method. search: the folders of ``sys.path``. hidden: folders that appear empty even if
        they lie in one that is shown. given: its environment, which says where weights are.
    """
    here = os.getcwd()
    # pip installs into a folder of one of these names, or into any other, beside the package's metadata
    installed = [path for path in search if Path(path).name in ("site-packages", "dist-packages")
                 or any(Path(path).glob("*.dist-info"))]
    # the method's own, and a package that is installed "editable", which lies where no folder of installed packages is
    own = packages_of(files_of(name))
    sources = [*packages_of(imports_of(name)), *own]
    named = [*named_files(dict(parameters), here).values(), *named_folders(dict(parameters), here).values()]
    weights = [given["VSFSIM_DINOV2"]] if "VSFSIM_DINOV2" in given else []
    weights += [os.path.join(given[key], "hub") for key in ("TORCH_HOME", "HF_HOME")]
    system = {*_SYSTEM, sys.prefix, sys.base_prefix, sys.exec_prefix}
    wanted = [*system, *installed, *vsfsim.__path__, folder("baselines"), *sources, *named,
              *weights, kernels(), *filter(None, os.environ.get("LD_LIBRARY_PATH", "").split(":"))]
    apart = {"/", os.path.expanduser("~"), "/tmp", "/home", *(path for path in _SYSTEM if os.path.islink(path))}
    paths = {form(path) for path in map(str, wanted) for form in (os.path.realpath, os.path.abspath)} - apart
    # of a method's own no digest is made, and it need not be of the source beside it
    bytecode = [path for package in own for path in package.rglob("__pycache__")]
    # which are written and read in a folder that is read-only, too; `os.walk` goes on where a folder vanishes
    pipes = [path for top in (*own, *named) for where, _, names in os.walk(top)
             for path in map(Path(where).joinpath, names) if path.is_fifo() or path.is_socket()]
    # in a wheel they lie inside the package
    shipped = [folder(name) for name in ("leaderboard", "scenes", "tasks")]
    # the working folder, the repository and archives of datasets, where they lie in the system's, as in /opt
    others = here, os.path.dirname(vsfsim.__path__[0]), os.environ.get("VSFSIM_ARCHIVES", here)
    emptied = [one for one in map(str, map(os.path.realpath, others)) if max(
        (path for path in paths if f"{one}/".startswith(f"{path}/")), key=len, default=one) in system - {one}]
    devices = {path for pattern in _DEVICES for path in glob.glob(pattern)}
    return {"shown": sorted({path for path in paths if os.path.exists(path)
                             and not path.startswith(("/proc", "/dev"))} | devices),
            "links": [(path, os.readlink(path)) for path in _SYSTEM if os.path.islink(path)],
            "hidden": [os.path.realpath(path) for path in (*hidden, *shipped, *bytecode, *pipes)],
            "emptied": emptied}
