"""Making a dataset so that it can be killed at any moment and taken up again."""

from __future__ import annotations

import os
import re
from pathlib import Path

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.file_lock import Held, release, sync_folder, take
from vsfsim.data.dataset import (
    FORMAT,
    LOCK,
    MANIFEST,
    PART_MANIFEST,
    Dataset,
    Entry,
    file_name,
    make_manifest,
    manifest_bytes,
    read_manifest,
)
from vsfsim.data.disk import file_sha256, write_atomic
from vsfsim.data.hdf5 import encode_view, read_view
from vsfsim.data.provenance import made_by
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.safety import check_name
from vsfsim.data.schema import SCHEMA_VERSION

_OUR_PART = re.compile(r"\.(h5|json)\.\d+\.part$")
"""Files that `write_atomic` left when it was killed; nothing else is ever removed from a folder."""


class DatasetWriter:
    """Writes, or goes on writing, one dataset folder.

    The order on disk is: dataset.part.json (recipe and names), the object files, dataset.json, and only then is
    dataset.part.json removed. So a folder without dataset.json is unfinished, and says of what.

    Args:
        path: the folder; made if it does not exist. An existing one must be empty or hold the same recipe.
        recipe: what is made.
        names: of all object views, in order.

    Attributes:
        notes: what was found and done at the start, one sentence each; for the user to see.

    Raises:
        DatasetError: the folder holds something else, another process writes it, or the disk refuses.
    """

    def __init__(self, path: str | Path, recipe: Recipe, names: list[str]):
        self.path, self.recipe, self.names = Path(path), recipe, list(names)
        self.notes: list[str] = []
        self._fresh = False  # dataset.part.json was made by this writer
        if len(set(self.names)) != len(self.names) or not self.names:
            raise DatasetError(f"names of object views must be unique and at least one, not {self.names!r}.")
        for name in self.names:
            check_name(name, "a name")
        self._made_folder = not self.path.exists()
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DatasetError(f"folder {self.path} cannot be made: {error.strerror}. Choose another --out.") from error
        # Refused before the lock is made, so that a folder of something else is left without a trace of us.
        self._refuse_other()
        self._lock: int | None = self._take_lock()
        try:
            self._made_by = self._begin()
        except BaseException:
            self.__exit__(BaseException)
            raise

    def file_of(self, name: str) -> Path:
        """Where the object view ``name`` goes; hand it to `vsfsim.data.hdf5.write_view` in a worker process."""
        return self.path / file_name(name)

    def missing(self) -> list[str]:
        """Names still to be made, in order. A file that does not open, or is not what it should be, counts as missing
        and is removed."""
        if self._finished is not None:
            return []
        out = []
        for name in self.names:
            path = self.file_of(name)
            if path.exists() and not self._is_whole(path, name):
                path.unlink()
                self.notes.append(f"{path.name} was damaged and is made again.")
            if not path.exists():
                out.append(name)
        return out

    def add(self, object_view: ObjectView) -> None:
        """Store one object view.

        Raises:
            DatasetError: a name that was not announced, a field that does not fit, or the disk refuses.
        """
        if object_view.name not in self.names:
            raise DatasetError(f"object view '{object_view.name}' is not one of the names of this dataset: "
                               f"{', '.join(self.names)}.")
        write_atomic(self.file_of(object_view.name), encode_view(object_view))

    def finish(self) -> Dataset:
        """Write dataset.json and let go of the folder.

        Raises:
            DatasetError: object views are missing, or the disk refuses.
        """
        if self._finished is None:
            entries = []
            for name in self.names:
                path = self.file_of(name)
                if not path.is_file():
                    raise DatasetError(f"{self.path}: object view '{name}' is missing; the dataset cannot be finished.")
                entries.append(describe(path))
            write_atomic(self.path / MANIFEST, make_manifest(self.recipe, self._made_by, tuple(entries)))
            (self.path / PART_MANIFEST).unlink(missing_ok=True)
            sync_folder(self.path)
        self.close()
        return Dataset.open(self.path)

    def close(self) -> None:
        """Let go of the folder, finished or not. Safe to call twice."""
        if self._lock is not None:
            _HELD.discard(self._lock)
            release(self._lock, self.path / LOCK)
            self._lock = None

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        # What cannot be made at all (a mesh without volume) leaves no trace; one finished file is worth resuming.
        if kind is not None and self._fresh and not any(self.path.glob("*.h5")):
            (self.path / PART_MANIFEST).unlink(missing_ok=True)
        self.close()
        if kind is not None and self._made_folder and self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    # ------------------------------------------------------------------ the start

    def _refuse_other(self) -> None:
        """Refuse a folder that holds something else than a start, or the whole, of this very dataset."""
        if (self.path / MANIFEST).exists():
            there, code = Dataset.open(self.path).recipe, None
        elif (self.path / PART_MANIFEST).exists():
            table = read_manifest(self.path / PART_MANIFEST)
            there, code = Recipe.read(table["recipe"], str(self.path / PART_MANIFEST)), table["made_by"]
        else:
            strangers = sorted(p.name for p in self.path.iterdir() if p.name != LOCK and not _OUR_PART.search(p.name))
            if strangers:
                raise DatasetError(f"folder {self.path} is not empty and holds no dataset "
                                   f"({', '.join(strangers[:5])}{', ...' if len(strangers) > 5 else ''}). Choose "
                                   f"another --out.")
            return
        differences = there.differences(self.recipe)
        if differences:
            raise DatasetError(f"folder {self.path} holds another dataset: {'; '.join(differences)}. Choose another "
                               f"--out, or delete that folder first.")
        if code is not None and dict(code) != made_by():
            raise DatasetError(f"folder {self.path} was begun by other code: {_code(code)} there, {_code(made_by())} "
                               f"here. Files of two versions are not mixed: "
                               f"check out that version to finish it, or delete the folder and start again.")

    def _begin(self) -> dict[str, str | None]:
        self._refuse_other()  # again, now that no other process can write
        self._finished: Dataset | None = None
        for part in self.path.iterdir():
            if _OUR_PART.search(part.name):
                part.unlink(missing_ok=True)
        if (self.path / MANIFEST).exists():
            finished = Dataset.open(self.path)
            bad = [e for e in finished.entries if not (self.path / e.file).is_file()
                   or file_sha256(self.path / e.file) != e.sha256]
            if not bad and list(finished.names()) == self.names:
                self._finished = finished
                (self.path / PART_MANIFEST).unlink(missing_ok=True)  # killed just before it was removed
                self.notes.append(f"{self.path} is finished already; nothing to do.")
                return dict(finished.made_by)
            if dict(finished.made_by) != made_by():
                raise DatasetError(f"{self.path}: {', '.join(e.file for e in bad)} missing or damaged, and the rest "
                                   f"was made by other code ({_code(finished.made_by)} there, "
                                   f"{_code(made_by())} here). Check out that version to repair it, or delete the "
                                   f"folder and start again.")
            for entry in bad:
                (self.path / entry.file).unlink(missing_ok=True)
                self.notes.append(f"{entry.file} was missing or damaged and is made again.")
        if not (self.path / PART_MANIFEST).exists():
            self._fresh = True
            write_atomic(self.path / PART_MANIFEST, manifest_bytes({
                "format": FORMAT, "schema_version": SCHEMA_VERSION, "made_by": made_by(),
                "recipe": self.recipe.table(), "names": self.names}))
        (self.path / MANIFEST).unlink(missing_ok=True)
        return made_by()

    def _is_whole(self, path: Path, name: str) -> bool:
        try:
            return read_view(path).name == name
        except DatasetError:
            return False

    def _take_lock(self) -> int:
        """A lock on dataset.lock: the system lets go of it when we die, so a stale lock cannot outlive its
        process."""
        try:
            handle, before = take(self.path / LOCK, unlocked=False)
        except Held as held:
            raise DatasetError(f"folder {self.path} is being written by process {held}. Wait for it, stop it, or "
                               f"choose another --out.") from None
        except OSError as error:
            raise DatasetError(f"folder {self.path} cannot be written: {error.strerror}. Free some space or choose "
                               f"another --out.") from error
        if before:
            self.notes.append(f"process {before} died while it wrote {self.path}; going on where it stopped.")
        _HELD.add(handle)
        return handle


def describe(path: Path) -> Entry:
    """The line of dataset.json for one object file."""
    view = read_view(path, blind=True)
    frames = sum(len(touch.time) for touch in view.touches)
    unconverged = sum(int((~touch.converged).sum()) for touch in view.touches)
    return Entry(view.name, path.name, view.split, view.object_index, view.view_index, len(view.touches), frames,
                 unconverged, path.stat().st_size, file_sha256(path))


def _code(made: object) -> str:
    table = dict(made)  # type: ignore[call-overload]
    return f"vsfsim {table.get('vsfsim')} at commit {table.get('commit') or 'unknown'}"


def _close_locks_in_child() -> None:
    # A forked worker would keep the lock alive after its parent was killed, and block the re-run.
    for handle in _HELD:
        os.close(handle)
    _HELD.clear()


_HELD: set[int] = set()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_locks_in_child)
