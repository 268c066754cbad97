"""Results that take long, kept on disk under a hash of what they were made from: read by who asks next, made by one
worker while the others wait."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from filelock import FileLock


def folder() -> Path:
    """``$XDG_CACHE_HOME/vsfsim`` or ``~/.cache/vsfsim``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vsfsim"


def kept(path: Path, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a cache file, or else those that ``make`` gives, which are kept there, whole or not at all.

    The system drops the lock of a file with its process, so that a killed worker leaves none behind. A folder that
    cannot be written, or a file system without locks, only costs double work.
    """
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(path.with_suffix(".lock")))
        found = _read(path)
        if found is None:
            found = make()
            with contextlib.suppress(OSError), tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part") as file:
                np.savez(file, **found)  # type: ignore[arg-type]
                file.flush()
                os.link(file.name, path)  # unlike a rename, it leaves the file of whoever came first
            # without locks another worker may have been first; every worker then uses its file
            found = _read(path) or found
        return found


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a file, or None if there is none; a damaged one is removed."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None
    except Exception:  # a damaged cache file is as good as none
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        return None
