"""One evaluation at a time writes a result: two would mix their answers and remove what the other keeps."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from vsfsim.core.errors import MethodError
from vsfsim.core.system.file_lock import lock, release

_BUSY = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)
"""What the system says of a lock that another process holds; on a file system without locks it says something else."""


@contextlib.contextmanager
def own(result: Path) -> Iterator[None]:
    """Hold the result file ``result`` for this process and the processes that it forks.

    Raises:
        MethodError: another evaluation writes it, or its folder cannot be written.
    """
    path = result.with_name(f".{result.name}.lock")
    made = [folder for folder in (result.parent, *result.parent.parents) if not folder.exists()]
    try:
        result.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        _take(handle, result)
        while not _is(handle, path):
            os.close(handle)  # whoever held it has just ended and removed it
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            _take(handle, result)
        os.ftruncate(handle, 0)
        os.write(handle, f"{os.getpid()}\n".encode())
    except OSError as error:
        raise MethodError(f"{result} cannot be written: {error.strerror}. Choose another --out.") from error
    try:
        yield
    finally:
        release(handle, path)
        with contextlib.suppress(OSError):  # what the evaluation wrote stays, and so do its folders
            for folder in made:
                folder.rmdir()


def _take(handle: int, result: Path) -> None:
    """Lock an open file; on a file system without locks nothing is locked."""
    try:
        lock(handle, wait=False)
    except OSError as error:
        if error.errno in _BUSY:
            holder = os.read(handle, 64).decode(errors="replace").strip() or "unknown"
            os.close(handle)
            raise MethodError(f"{result} is being written by process {holder}. Wait for it, stop it, or choose another "
                              f"--out.") from None


def _is(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
