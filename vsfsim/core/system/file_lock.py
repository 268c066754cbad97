"""Locks on files that the system drops with their process, so that a killed one leaves none behind.

POSIX has `fcntl.flock`, Windows `msvcrt.locking`. Where there is neither, nothing is locked.
"""

from __future__ import annotations

import contextlib
import errno
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

_BUSY = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
"""What the system says of a lock that another process holds; on a file system without locks it says something else."""
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


class Held(Exception):
    """Another process holds the lock; the message is its process id, or "unknown"."""


def take(path: Path, *, unlocked: bool) -> tuple[int, str]:
    """Lock the file ``path``, which is made if it is missing, and write our process id into it.

    Args:
        path: of the lock; `release` removes it.
        unlocked: whether to go on on a file system without locks, else that counts as held by somebody unknown.

    Returns:
        The file descriptor, and the process id that was in the file: of a process that died while it held it, or "".

    Raises:
        Held: another process holds it.
        OSError: the file cannot be written.
    """
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            try:
                lock(handle, wait=False)
            except OSError as error:
                if error.errno in _BUSY or not unlocked:
                    raise Held(_content(handle) or "unknown") from None
            if path.exists() and path.stat().st_ino == os.fstat(handle).st_ino:
                before = _content(handle)
                os.ftruncate(handle, 0)
                os.lseek(handle, 0, os.SEEK_SET)
                os.write(handle, f"{os.getpid()}\n".encode())
                return handle, before
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its last holder ended and removed it while we opened it


def _content(handle: int) -> str:
    os.lseek(handle, 0, os.SEEK_SET)
    return os.read(handle, 64).decode(errors="replace").strip()


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
