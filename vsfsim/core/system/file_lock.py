"""Locks on files that the system drops with their process, so that a killed one leaves none behind.

POSIX has `fcntl.flock`, Windows `msvcrt.locking`. Where there is neither, nothing is locked.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from types import ModuleType

fcntl: ModuleType | None
msvcrt: ModuleType | None
try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None
try:
    import msvcrt
except ImportError:  # not Windows
    msvcrt = None

_FAR = 1 << 30
"""Place of the locked byte on Windows [byte], behind the content, which others may then read."""


def lock(handle: int, *, wait: bool) -> None:
    """Lock the open file ``handle`` until it is closed.

    Args:
        handle: file descriptor.
        wait: whether to wait for another process that holds it.

    Raises:
        OSError: another process holds it and ``wait`` is False, or the file system has no locks.
    """
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    elif msvcrt is not None:
        os.lseek(handle, _FAR, os.SEEK_SET)
        while True:
            try:
                msvcrt.locking(handle, msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
                return
            except OSError:
                if not wait:
                    raise  # LK_LOCK itself gives up after ten seconds; a waiting process asks again


def sync_folder(folder: Path) -> None:
    """Make the entries of ``folder`` durable; on Windows, where a folder cannot be opened, the system does."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def release(handle: int, path: Path) -> None:
    """Remove the locked file ``path`` and close it: in this order on POSIX, so that nobody locks a file that is about
    to go; Windows does not remove an open file."""
    if os.name != "nt":
        path.unlink(missing_ok=True)
        os.close(handle)
        return
    os.close(handle)
    with contextlib.suppress(OSError):  # another process may have taken it in between
        path.unlink(missing_ok=True)
