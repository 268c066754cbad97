"""Where the files of a dataset lie: a folder, which machines may share, or an address of an object store.

Three operations suffice for machines that know nothing of one another: put a file whole, put it only if it is not
there, and list. A folder has them by renames and links, an object store by puts and conditional puts.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from vsfsim.core.errors import DatasetError
from vsfsim.data.disk import own_number, write_atomic


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
                (self._path / name).parent.mkdir(exist_ok=True)
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

    def get(self, name: str) -> bytes | None:
        """The content of a file, None if it is not there."""
        with self._named(name, "read"), contextlib.suppress(FileNotFoundError):
            return self._files.cat_file(f"{self._root}/{name}")
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
