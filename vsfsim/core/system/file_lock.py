"""Locks on files, by the package filelock: the system drops them with their process, so that a killed one leaves none
behind."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from filelock import FileLock, Timeout

from vsfsim.core.errors import VsfsimError


def take(path: Path, target: Path, error: type[VsfsimError], *, needed: bool = False,
         wait: bool = False) -> tuple[FileLock, str]:
    """Lock the file ``path``, which is made if it is missing, its folder too, and write our process id into it.

    Args:
        path: of the lock; `release` removes it.
        target: what is written under the lock, for messages.
        error: the class of the errors.
        needed: whether nothing may be written without a lock, as on a file system that has none.
        wait: for a process that holds it.

    Returns:
        The lock, and the process id that was in the file: of a process that died while it held it, or "".

    A process that is forked does not hold it. On a file system without locks nobody does.

    Raises:
        VsfsimError: of class ``error``; another process holds it, the file cannot be written, or the file system lacks
            locks and one is needed.
    """
    lock = FileLock(path, timeout=-1 if wait else 0, thread_local=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except OSError as problem:
            # a file that can be made and not locked lies on a file system without locks
            if isinstance(problem, Timeout) or not os.access(path, os.W_OK):
                raise
            if needed:
                raise error(f"'{target}' lies on a file system without locks, where two processes could write one "
                            f"file. Choose another --out, on a local disk.") from problem
        before = _content(path)
        path.write_text(f"{os.getpid()}\n")
    except Timeout:
        raise error(f"'{target}' is being written by process {_content(path) or 'unknown'}. Wait for it, stop it, or "
                    f"choose another --out.") from None
    except OSError as problem:
        raise error(f"'{target}' cannot be written: {problem.strerror}. Free some space or choose another "
                    f"--out.") from problem
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
