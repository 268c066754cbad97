"""What a container shows a method, and which kind of container this system has.

Read-only: the system's libraries, Python's installation, every folder of `sys.path`, and the files and folders that the
method's parameters name. Writable: an empty /tmp, the folder in which it works, and the caches of compiled kernels.
GPUs are there. Hidden: the datasets, the results, the rest of the home folder, other processes, the network.
"""

from __future__ import annotations

import contextlib
import functools
import glob
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.bench.isolation import namespaces
from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import methods
from vsfsim.core.system.content import named_files, source_files

SANDBOXES = ("bubblewrap", "namespaces", "process")
"""The strongest first: the program bwrap, the same by our own system calls, and a process without a container."""

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc", "/opt", "/nix", "/gnu", "/sys")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/nvidia*", "/dev/dri",
            "/dev/kfd", "/dev/dxg")
_CACHES = ("WARP_CACHE_PATH", "NUMBA_CACHE_DIR")
"""Variables that name folders of caches."""
_WEIGHTS = ("TORCH_HOME", "HF_HOME", "VSFSIM_DINOV2")
"""Variables that name folders of weights."""


@dataclass(frozen=True)
class Places:
    """What is shown, by absolute path."""

    shown: tuple[tuple[str, bool], ...]
    """Files and folders, and whether they may be written; a folder comes before what lies in it."""
    links: tuple[tuple[str, str], ...]
    """Links of the system, and what they point to."""
    devices: tuple[str, ...]
    """Files and folders of devices."""
    hidden: tuple[str, ...]
    """Folders that appear empty."""
    folder: str
    """Where the method works."""


def strongest() -> str:
    """The first of `SANDBOXES` that works here."""
    return next(name for name in SANDBOXES if works(name))


@functools.cache
def works(sandbox: str) -> bool:
    """Whether a sandbox works here; it is tried."""
    if sandbox == "process":
        return True
    if sys.platform != "linux":
        return False
    program = shutil.which("bwrap")
    words = [sys.executable, "-I", "-S", namespaces.__file__] if sandbox == "namespaces" else [
        program or "", "--unshare-all", "--cap-drop", "ALL", "--ro-bind", "/", "/", "--proc", "/proc", "--",
        "/bin/true"]
    try:
        return bool(words[0]) and subprocess.run(words, capture_output=True, timeout=20.0).returncode == 0
    except (OSError, subprocess.SubprocessError):
        return False


def require(sandbox: str) -> None:
    """Refuse a sandbox that does not work here.

    Raises:
        MethodError: with what it needs.
    """
    if sandbox == "bubblewrap" and shutil.which("bwrap") is None:
        raise MethodError("--sandbox bubblewrap needs the program 'bwrap', which is not installed. Install the package "
                          "'bubblewrap' of your system, or leave --sandbox away for the strongest one that is here.")
    if not works(sandbox):
        raise MethodError(f"--sandbox {sandbox} does not work here: the system does not allow new namespaces (in a "
                          f"container it needs the right to make them). Leave --sandbox away for the strongest one "
                          f"that works: {strongest()}.")


def places(name: str, parameters: Mapping[str, Any], *, search: Iterable[str], hidden: Iterable[Path],
           folder: Path) -> Places:
    """What a method is shown.

    Args:
        name, parameters: of the method. search: the folders of ``sys.path``. hidden: folders that
        appear empty even if they lie in one that is shown. folder: the one in which it works.
    """
    home, here = os.path.expanduser("~"), os.getcwd()
    modules = [path for path in search if path != here] + [here] * (":" in name)
    # a module may lie where no folder of sys.path is: in a package that is installed "editable", or at home
    entry = name if ":" in name or name not in methods() else methods()[name].value
    needed = ((entry.partition(":")[0], here), ("vsfsim.bench.isolation.child", ""), ("vsfsim.bench.check", ""))
    files = [file for module, folder in needed for file in source_files(module, folder).values()]
    packages = {file.parent for file in files if (file.parent / "__init__.py").is_file()}
    modules += [*map(str, files), *map(str, packages)]
    folders = [Path(here, text) for text in parameters.values() if isinstance(text, str) and "/" in text]
    named = [*named_files(dict(parameters), here).values(), *(path for path in folders if len(str(path)) < 1000
                                                              and path.is_dir())]
    cache = Path(os.environ.get("XDG_CACHE_HOME", f"{home}/.cache"))
    warp = Path(os.environ.get("WARP_CACHE_PATH", cache / "warp"))
    with contextlib.suppress(OSError):
        warp.mkdir(parents=True, exist_ok=True)  # kernels that are compiled inside would else be lost
    weights = [os.environ[name] for name in _WEIGHTS if name in os.environ] + [str(cache / "torch"),
                                                                              str(cache / "huggingface")]
    readable = [*_SYSTEM, sys.prefix, sys.base_prefix, sys.exec_prefix, *modules, *weights, *map(str, named),
                *os.environ.get("LD_LIBRARY_PATH", "").split(":")]
    readable = [path for path in readable if path]
    kinds = {path: False for path in (*map(os.path.realpath, readable), *map(os.path.abspath, readable))}
    caches = (str(warp), *(os.environ[name] for name in _CACHES if name in os.environ))
    kinds |= {os.path.realpath(path): True for path in caches}
    kinds[str(folder)] = True
    links = tuple((path, os.readlink(path)) for path in _SYSTEM if os.path.islink(path))
    apart = {"/", home, tempfile.gettempdir(), "/tmp", "/home", *(path for path, _ in links)}
    shown = tuple((path, kinds[path]) for path in sorted(kinds)
                  if path not in apart and not path.startswith(("/proc", "/dev")) and os.path.exists(path))
    devices = tuple(sorted(path for pattern in _DEVICES for path in glob.glob(pattern)))
    return Places(shown, links, devices, tuple(os.path.realpath(p) for p in hidden if p.is_dir()), str(folder))


def bubblewrap(words: Sequence[str], where: Places) -> list[str]:
    """``words`` inside bubblewrap."""
    out = [shutil.which("bwrap") or "bwrap", "--die-with-parent", "--unshare-all", "--cap-drop", "ALL", "--new-session",
           "--proc", "/proc", "--dev", "/dev", "--tmpfs", "/tmp"]
    for path, target in where.links:
        out += ["--symlink", target, path]
    for path in where.devices:
        out += ["--dev-bind", path, path]
    for path, writable in where.shown:
        out += ["--bind" if writable else "--ro-bind", path, path]
    for path in where.hidden:
        out += ["--tmpfs", path]
    return [*out, "--chdir", where.folder, "--", *words]


def entry(where: Places, root: Path) -> dict[str, Any]:
    """The operand of `namespaces.enter`; ``root`` is an empty folder."""
    shown = [*((path, True) for path in where.devices), *where.shown]
    return {"root": str(root), "shown": shown, "links": where.links, "hidden": where.hidden, "folder": where.folder}
