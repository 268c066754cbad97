"""Putting bytes on disk whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shutil
import socket
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError, VsfsimError
from vsfsim.core.system.content import file_sha256 as file_sha256
from vsfsim.core.system.file_lock import sync_folder


def write_atomic(path: Path, content: bytes, *, error: type[VsfsimError] = DatasetError) -> None:
    """Write ``content`` to ``path`` so that a reader, or a crash, sees the old file or the new one, never a part. Its
    folder is made if it is missing.

    The bytes go to ``<name>.<number>.part`` beside it, are synced, and renamed; then the folder is synced, because
    a rename is only as durable as the folder that holds it. The number is that of `own_number`, so that neither a
    worker orphaned by a killed run nor another machine writes into this part. What is there and no file, a device or a
    pipe, is written into.

    Raises:
        VsfsimError: of class ``error``; the folder cannot be made, or the disk is full or refuses to be written. The
        part is removed.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise error(f"folder {path.parent} cannot be made: {problem.strerror}. Choose another one.") from problem
    part = path.with_name(f"{path.name}.{own_number()}.part")
    try:
        if path.exists() and not path.is_file():  # a folder is refused here
            path.write_bytes(content)
            return
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
        sync_folder(path.parent)
    except OSError as problem:
        part.unlink(missing_ok=True)
        raise error(_complaint(path, len(content), problem)) from problem
    except BaseException:
        part.unlink(missing_ok=True)
        raise


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


def write_figure(figure: Any, path: str | Path) -> None:
    """Write a `matplotlib.figure.Figure` to a file; its ending says the format, PNG without one.

    Raises:
        VsfsimError: the disk is full or refuses to be written.
    """
    path, buffer = Path(path), io.BytesIO()
    figure.savefig(buffer, format=path.suffix[1:].lower() or "png")
    write_atomic(path if path.suffix else path.with_suffix(".png"), buffer.getvalue(), error=VsfsimError)


def own_number() -> str:
    """Digits that no other process has which may write to the same folder: of process and machine."""
    return f"{os.getpid()}{zlib.crc32(socket.gethostname().encode()):010d}"


def _complaint(path: Path, size: int, problem: OSError) -> str:
    if problem.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return (f"{path} cannot be written: {problem.strerror} ({size / 1e6:.1f} MB were needed for this file). "
                f"Nothing half-written is left. "
                f"Free some space, or choose a folder on another disk, and run the same command again; finished "
                f"files are kept.")
    return (f"{path} cannot be written: {problem.strerror or problem}. Choose a folder that exists and that you "
            f"may write to.")
