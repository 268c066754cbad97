"""Locks on files, by the package filelock: the system drops them with their process, so that a killed one leaves none
behind."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from filelock import FileLock, Timeout


class Held(Exception):
    """Another process holds the lock; the message is its process id, or "unknown"."""


def take(path: Path, *, unlocked: bool) -> tuple[FileLock, str]:
    """Lock the file ``path``, which is made if it is missing, and write our process id into it.

    Args:
        path: of the lock; `release` removes it.
        unlocked: whether to go on on a file system without locks, else that counts as held by somebody unknown.

    Returns:
        The lock, and the process id that was in the file: of a process that died while it held it, or "".

    A process that is forked does not hold it.

    Raises:
        Held: another process holds it.
        OSError: the file cannot be written.
    """
    lock = FileLock(path, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        raise Held(_content(path) or "unknown") from None
    except OSError:
        # a file that can be made and not locked lies on a file system without locks
        if not os.access(path, os.W_OK):
            raise
        if not unlocked:
            raise Held("unknown") from None
    before = _content(path)
    path.write_text(f"{os.getpid()}\n")
    return lock, before


def release(lock: FileLock) -> None:
    """Remove a locked file and unlock it: in this order on POSIX, so that nobody locks a file that is about to go;
    Windows does not remove an open file."""
    path = Path(lock.lock_file)
    if os.name != "nt":
        path.unlink(missing_ok=True)
    lock.release()
    with contextlib.suppress(OSError):  # another process may have taken it in between
        if os.name == "nt":
            path.unlink(missing_ok=True)


def _content(path: Path) -> str:
    with contextlib.suppress(OSError):  # gone in between, or held on Windows
        return path.read_text(errors="replace").strip()[:64]
    return ""


def sync_folder(folder: Path) -> None:
    """Make the entries of ``folder`` durable; on Windows, where a folder cannot be opened, the system does."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
