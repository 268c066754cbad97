"""Results that take long, kept on disk under a hash of what they were made from: read by whoever asks next, made by one
worker while the others wait."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from filelock import FileLock


def folder() -> Path:
    """``$XDG_CACHE_HOME/vsfsim`` or ``~/.cache/vsfsim``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "vsfsim"


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock that belongs to a cache file. The system drops it with the process, so a killed worker leaves none
    behind."""
    with contextlib.ExitStack() as stack:
        # a folder that cannot be written, or a file system without locks, only costs double work
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(FileLock(path.with_suffix(".lock")))
        yield


def read(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a cache file, or None if there is none; a damaged one is removed."""
    try:
        with np.load(path, allow_pickle=False) as data:
            return {name: data[name] for name in data.files}
    except (FileNotFoundError, NotADirectoryError, PermissionError):
        return None
    except Exception:  # a damaged cache file is as good as none
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)
        return None


def write(path: Path, **arrays: np.ndarray) -> None:
    """Keep ``arrays`` in a cache file, whole or not at all; the file of whoever came first stays."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
    except OSError:
        return  # a cache that cannot be written only costs time
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **arrays)
        os.link(name, path)  # unlike a rename, it leaves the file of whoever came first
    except OSError:
        pass
    finally:
        os.unlink(name)
