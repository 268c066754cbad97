"""Where the files of a dataset lie: a folder, which machines may share, or an address of an object store.

Three operations suffice for machines that know nothing of one another: put a file whole, put it only if it is not
there, and list. A folder has them by renames and links, an object store by puts and conditional puts.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.extras import missing_package
from vsfsim.data.disk import own_number, write_atomic


class Store:
    """The files of one dataset, by names with "/" between folders, in a folder of this machine or one that several
    machines share.

    Raises:
        DatasetError: of all operations; a file cannot be written or read.
    """

    where: str
    """Path of the folder, or the address."""

    def __init__(self, path: Path):
        self.where, self._path = str(path), path

    def put(self, name: str, content: bytes) -> None:
        """Write a file, so that a reader sees the old one or the new one whole."""
        write_atomic(self._path / name, content)

    def put_new(self, name: str, content: bytes) -> bool:
        """Write a file if there is none of that name; returns whether this call has written it."""
        # a hard link fails if the name is taken, also between machines that share the folder
        path = self._path / name
        whole = path.with_name(f"{path.name}.{own_number()}.new")
        write_atomic(whole, content)
        try:
            os.link(whole, path)
            return True
        except FileExistsError:
            return False
        except OSError:  # a file system without hard links: the first rename that finds no file wins
            if path.exists():
                return False
            os.replace(whole, path)
            return True
        finally:
            whole.unlink(missing_ok=True)

    def get(self, name: str) -> bytes | None:
        """The content of a file, None if it is not there."""
        try:
            return (self._path / name).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise DatasetError(f"{self._path / name} cannot be read: {error.strerror}.") from error

    def sizes(self, folder: str = "") -> dict[str, int]:
        """Sizes [byte] of the files of one folder by their names in it; {} if it is not there."""
        try:
            with os.scandir(self._path / folder) as items:
                return {item.name: item.stat().st_size for item in items if item.is_file()}
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise DatasetError(f"{self._path / folder} cannot be read: {error.strerror}.") from error

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        (self._path / name).unlink(missing_ok=True)


class UrlStore(Store):
    """An object store that fsspec reaches, e.g. s3://bucket/folder."""

    def __init__(self, url: str):
        try:
            import fsspec
        except ModuleNotFoundError:
            raise missing_package("fsspec", "cloud") from None
        self.where = url.rstrip("/")
        try:
            self._files, root = fsspec.core.url_to_fs(self.where)
        except (ImportError, ValueError) as error:
            raise DatasetError(f"the address '{url}' cannot be used: {error}. Install the extra 'cloud' (pip install "
                               f"\"vsfsim[cloud]\") for s3://, and the package that fsspec names for others.") from None
        self._root = root.rstrip("/")

    def put(self, name: str, content: bytes) -> None:
        """See `Store.put`."""
        with self._named(name, "written"):
            self._files.pipe_file(f"{self._root}/{name}", content)

    def put_new(self, name: str, content: bytes) -> bool:
        """See `Store.put_new`; a conditional put."""
        with self._named(name, "written"):
            try:
                self._files.pipe_file(f"{self._root}/{name}", content, mode="create")
            except FileExistsError:
                return False
            return True

    def get(self, name: str) -> bytes | None:
        """See `Store.get`."""
        with self._named(name, "read"):
            try:
                return self._files.cat_file(f"{self._root}/{name}")
            except FileNotFoundError:
                return None

    def sizes(self, folder: str = "") -> dict[str, int]:
        """See `Store.sizes`."""
        with self._named(folder, "read"):
            self._files.invalidate_cache()
            try:
                rows: list[dict[str, Any]] = self._files.ls(f"{self._root}/{folder}".rstrip("/"), detail=True)
            except FileNotFoundError:
                return {}
            return {row["name"].rpartition("/")[2]: row["size"] for row in rows if row["type"] == "file"}

    def remove(self, name: str) -> None:
        """See `Store.remove`."""
        with self._named(name, "removed"), contextlib.suppress(FileNotFoundError):
            self._files.rm_file(f"{self._root}/{name}")

    @contextlib.contextmanager
    def _named(self, name: str, done: str) -> Any:
        try:
            yield
        except Exception as error:  # every implementation of fsspec raises errors of its own
            raise DatasetError(f"{self.where}/{name} cannot be {done}: {type(error).__name__}: {error}. Look at the "
                               f"address and your credentials, and run the same command again.") from error


def is_url(where: str | Path) -> bool:
    """Whether this is an address of an object store, not a path."""
    return "://" in str(where)


def open_store(where: str | Path) -> Store:
    """The store at a path or an address.

    Raises:
        DatasetError: no installed package can use such an address. MissingPackage: fsspec is not installed.
    """
    return UrlStore(str(where)) if is_url(where) else Store(Path(where))
