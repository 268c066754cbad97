"""The command line of bubblewrap: a container that shows a method the packages that it needs and no data.

Read-only: the system's libraries, Python's installation and every folder of `sys.path`. Writable: an empty /tmp and
the caches of compiled kernels. Hidden: the datasets, the results, the rest of the home folder, other processes, the
network.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from vsfsim.core.errors import MethodError

_SYSTEM = ("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/etc", "/opt", "/sys/devices/system/cpu")
_CACHES = ("WARP_CACHE_PATH", "TORCH_HOME", "HF_HOME", "NUMBA_CACHE_DIR")
"""Variables that name folders of caches."""


def command(words: Sequence[str], *, search: Iterable[str], hidden: Iterable[Path], folder: Path) -> list[str]:
    """``words`` inside a container.

    Args:
        words: of the command.
        search: the folders of ``sys.path``, which are shown read-only.
        hidden: folders that appear empty even if they lie in one that is shown.
        folder: the empty folder in which the method works; it appears under its own name.

    Raises:
        MethodError: bubblewrap is not installed.
    """
    program = shutil.which("bwrap")
    if program is None:
        raise MethodError("--sandbox bubblewrap needs the program 'bwrap', which is not installed. Install the package "
                          "'bubblewrap' of your system, or leave --sandbox away.")
    out = [program, "--die-with-parent", "--unshare-all", "--new-session", "--proc", "/proc", "--dev", "/dev",
           "--tmpfs", "/tmp"]
    shown = [*_SYSTEM, sys.prefix, sys.base_prefix, sys.exec_prefix, *search]
    shown = [os.path.realpath(path) for path in shown] + [os.path.abspath(path) for path in shown]
    home = os.path.expanduser("~")
    for path in sorted(set(shown)):  # a folder comes before what lies in it
        if os.path.exists(path) and path not in ("/", home) and not path.startswith("/proc"):
            out += ["--symlink", os.readlink(path), path] if os.path.islink(path) and path in _SYSTEM else [
                "--ro-bind", path, path]
    for cache in [Path(home) / ".cache" / "warp", *(Path(os.environ[name]) for name in _CACHES if name in os.environ)]:
        if cache.is_dir():
            out += ["--bind", str(cache), str(cache)]
    for empty in hidden:
        if empty.is_dir():
            out += ["--tmpfs", os.path.realpath(empty)]
    return [*out, "--bind", str(folder), str(folder), "--chdir", str(folder), "--", *words]
