"""One evaluation at a time writes a result: two would mix their answers and remove what the other keeps."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from vsfsim.core.errors import MethodError
from vsfsim.core.system.file_lock import Held, release, take


@contextlib.contextmanager
def own(result: Path) -> Iterator[None]:
    """Hold the result file ``result`` for this process.

    Raises:
        MethodError: another evaluation writes it, or its folder cannot be written.
    """
    path = result.with_name(f".{result.name}.lock")
    made = [folder for folder in (result.parent, *result.parent.parents) if not folder.exists()]
    try:
        result.parent.mkdir(parents=True, exist_ok=True)
        lock, _ = take(path, unlocked=True)
    except Held as held:
        raise MethodError(f"{result} is being written by process {held}. Wait for it, stop it, or choose another "
                          f"--out.") from None
    except OSError as error:
        raise MethodError(f"{result} cannot be written: {error.strerror}. Choose another --out.") from error
    try:
        yield
    finally:
        release(lock)
        with contextlib.suppress(OSError):  # what the evaluation wrote stays, and so do its folders
            for folder in made:
                folder.rmdir()
