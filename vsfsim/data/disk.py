"""Putting bytes on disk whole or not at all; and where the files of a dataset lie: a folder, which machines may share,
or an address of an object store.

Three operations suffice for machines that know nothing of one another: put a file whole, put it only if it is not
there, and list. A folder has them by renames and links, an object store by puts and conditional puts.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shutil
import socket
import zlib
from collections.abc import Iterable, Iterator, Sequence
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
    part = path.parent / f"{path.name}.{own_number()}.part"  # the name is empty if the path is
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


def write_animation(path: Path, figures: Iterable[Any], milliseconds: Sequence[int], *, dpi: int = 100) -> None:
    """Write figures of matplotlib, one after the other, as a GIF that repeats, of 256 colours a frame.

    Raises:
        VsfsimError: the file cannot be written.
    """
    from PIL import Image

    frames = []
    for figure in figures:
        figure.savefig(buffer := io.BytesIO(), format="png", dpi=dpi)
        frames.append(Image.open(buffer).convert("RGB").quantize(256, method=Image.Quantize.FASTOCTREE))
    (first, *others), whole = frames, io.BytesIO()
    first.save(whole, "GIF", save_all=True, append_images=others, loop=0, optimize=True, duration=list(milliseconds))
    write_atomic(path, whole.getvalue(), error=VsfsimError)


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


class Store:
    """The files of one dataset, by names with "/" between folders: in a folder of this machine or one that several
    machines share, or at an address that fsspec reaches, e.g. s3://bucket/folder.

    Raises:
        DatasetError: no installed package can use the address; of all operations, a file cannot be written or read.
    """

    where: str
    """Path of the folder, or the address."""

    def __init__(self, where: str | Path):
        import fsspec  # takes a tenth of a second

        self._path = None if is_url(where) else Path(where)
        self.where = str(self._path or where).rstrip("/")
        try:
            found: tuple = fsspec.core.url_to_fs(self.where) if self._path is None else (
                fsspec.filesystem("file"), os.path.abspath(where))
        except (ImportError, ValueError) as error:
            raise DatasetError(f"the address '{where}' cannot be used: {error}. Install the extra 'cloud' (pip install "
                               f"\"vsfsim[cloud]\") for s3://, and the package that fsspec names for others.") from None
        self._files, self._root = found

    def put(self, name: str, content: bytes) -> None:
        """Write a file, so that a reader sees the old one or the new one whole."""
        with self._named(name, "written"):
            if self._path is None:
                self._files.pipe_file(f"{self._root}/{name}", content)
            else:
                write_atomic(self._path / name, content)

    def put_new(self, name: str, content: bytes) -> bool:
        """Write a file if there is none of that name; returns whether this call has written it."""
        with self._named(name, "written"), contextlib.suppress(FileExistsError):
            if self._path is None:
                self._files.pipe_file(f"{self._root}/{name}", content, mode="create")
                return True
            path = self._path / name
            whole = f"{name}.{own_number()}.new"
            self.put(whole, content)
            try:  # a hard link fails if the name is taken, also between machines that share the folder
                os.link(self._path / whole, path)
                return True
            except OSError:  # a file system without hard links: the first rename that finds no file wins
                if not path.exists():
                    os.replace(self._path / whole, path)
                    return True
            finally:
                self.remove(whole)
        return False

    def get(self, name: str, *, most: int | None = None) -> bytes | None:
        """The content of a file, its first ``most`` bytes if they are given; None if it is not there."""
        with self._named(name, "read"), contextlib.suppress(FileNotFoundError):
            return self._files.cat_file(f"{self._root}/{name}", end=most)
        return None

    def sizes(self, folder: str = "") -> dict[str, int]:
        """Sizes [byte] of the files of one folder by their names in it; {} if it is not there."""
        with self._named(folder, "read"), contextlib.suppress(FileNotFoundError):
            self._files.invalidate_cache()
            rows = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=True)
            return {row["name"].rpartition("/")[2]: row["size"] for row in rows if row["type"] == "file"}
        return {}

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with self._named(name, "removed"), contextlib.suppress(FileNotFoundError):
            self._files.rm_file(f"{self._root}/{name}")

    @contextlib.contextmanager
    def _named(self, name: str, done: str) -> Iterator[None]:
        try:
            yield
        except DatasetError:
            raise
        except Exception as error:  # every implementation of fsspec raises errors of its own
            todo = "Look at the address and your credentials" if self._path is None else "Choose another folder"
            raise DatasetError(f"{self.where}/{name} cannot be {done}: {type(error).__name__}: {error}. {todo}, and "
                               f"run the same command again.") from error


def is_url(where: str | Path) -> bool:
    """Whether this is an address of an object store, not a path."""
    return "://" in str(where)
