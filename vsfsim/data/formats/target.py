"""A folder that appears whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.file_lock import sync_folder
from vsfsim.data.disk import own_number


@contextlib.contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to write into, which gets the name ``path`` when the block ends well: killed before, there is no
    ``path``, and killed after, it is whole. What an earlier try left is removed.

    Raises:
        DatasetError: ``path`` is there already, or the disk refuses.
    """
    if path.exists():
        raise DatasetError(f"--out is '{path}', which exists already. Give a new folder.")
    part = path.with_name(f".{path.name}.{own_number()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in path.parent.glob(f".{path.name}.*.part"):
            shutil.rmtree(old)
        part.mkdir()
        yield part
        for file in part.rglob("*"):
            if file.is_file():
                with open(file, "rb") as handle:
                    os.fsync(handle.fileno())
        os.rename(part, path)
        sync_folder(path.parent)
    except OSError as error:
        raise DatasetError(f"'{path}' cannot be written: {error.strerror or error}. Free some space or choose another "
                           f"--out, and run the same command again.") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
