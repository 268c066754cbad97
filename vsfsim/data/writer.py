"""Making a dataset so that it can be killed at any moment and taken up again, by one machine or by many."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from filelock import FileLock

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.file_lock import release, sync_folder, take
from vsfsim.data import lines
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import Store, file_sha256, is_url
from vsfsim.data.manifest import (
    CARD,
    FORMAT,
    LOCK,
    MANIFEST,
    PART_MANIFEST,
    Entry,
    card,
    file_name,
    make_manifest,
    manifest_bytes,
    parse_manifest,
)
from vsfsim.data.provenance import machine_kind, made_by
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.safety import check_name
from vsfsim.data.schema import SCHEMA_VERSION

_OUR_PART = re.compile(r"\.(h5|json|md)(\.\d+\.(part|new))+$")
"""Files that `write_atomic` left when it was killed; nothing else is ever removed from a folder."""
_SHARD_LOCK = re.compile(r"shard-\d+-of-\d+\.lock$")


class DatasetWriter:
    """Writes, or goes on writing, one dataset.

    The order on disk is: dataset.part.json (recipe and names), the object files, each followed by its line of the
    manifest (`vsfsim.data.lines`), dataset.json, and only then are dataset.part.json and the manifest removed. So what
    has no dataset.json is unfinished, and says of what; and a file without its line is made again.

    Args:
        path: the folder, made if it does not exist, or the address of an object store. One that exists must be empty or
            hold the same recipe.
        recipe: what is made.
        names: of all object views, in order.
        shard: (i, n) to make the i-th of n shards, from 0, beside others; None to own the dataset.

    Attributes:
        notes: what was found and done at the start, one sentence each; for the user to see.

    Raises:
        DatasetError: the folder holds something else, another process writes it, or the disk refuses.
    """

    def __init__(self, path: str | Path, recipe: Recipe, names: list[str], *, shard: tuple[int, int] | None = None):
        self.recipe, self.names, self.shard = recipe, list(names), shard
        self.store = Store(path)
        self.path: Path | None = None if is_url(path) else Path(path)
        self.notes: list[str] = []
        self._fresh = False  # dataset.part.json was made by this writer
        if len(set(self.names)) != len(self.names) or not self.names:
            raise DatasetError(f"names of object views must be unique and at least one, not {self.names!r}.")
        for name in self.names:
            check_name(name, "a name")
        self._made_folder = self.path is not None and not self.path.exists()
        # Refused before the lock is made, so that a folder of something else is left without a trace of us.
        self._refuse_other()
        self._lock = self._take_lock()
        try:
            self._made_by = self._begin()
        except BaseException:
            self.__exit__(BaseException)
            raise

    def missing(self) -> list[str]:
        """Names still to be made, in order: those without a line, and those whose file is not what its line says, which
        is removed. The owner of a folder reads every byte; of a shard or an object store the sizes are compared."""
        if self._finished is not None:
            return []
        done, sizes = lines.finished_names(self.store), self.store.sizes()
        for name in self.names if self.shard is None and self.path is not None else ():
            line = lines.read_line(self.store, name) if name in done else None
            if name in done and (line is None or not self._is_whole(line, sizes)):
                lines.forget(self.store, name)
                self.notes.append(f"{file_name(name)} was damaged and is made again.")
                done.discard(name)
        return [name for name in self.names if name not in done or file_name(name) not in sizes]

    def add(self, object_view: ObjectView, made_on: str = "") -> None:
        """Store one object view.

        Args:
            object_view: with its truth.
            made_on: kind of machine, "" for this CPU.

        Raises:
            DatasetError: a name that was not announced, a field that does not fit, or the disk refuses.
        """
        if object_view.name not in self.names:
            raise DatasetError(f"object view '{object_view.name}' is not one of the names of this dataset: "
                               f"{', '.join(self.names)}.")
        lines.put_view(self.store, object_view, self.recipe, made_on or machine_kind())

    def finish(self, *, leave_out: bool = False) -> Dataset:
        """Write README.md and dataset.json and let go of the folder.

        Args:
            leave_out: whether object views that failed twice may be left out.

        Raises:
            DatasetError: object views are missing or damaged, or the disk refuses.
        """
        if self._finished is None:
            left_out = lines.poisoned(self.store) if leave_out else {}
            entries = self._entries([name for name in self.names if name not in left_out])
            self.store.put(CARD, card(self.recipe, self._made_by, entries, left_out).encode())
            self.store.put(MANIFEST, make_manifest(self.recipe, self._made_by, entries, left_out))
            self.store.remove(PART_MANIFEST)
            lines.clear(self.store)
            if self.path is not None:
                sync_folder(self.path)
        self.close()
        return Dataset.open(self.store.where)

    def _entries(self, names: list[str]) -> tuple[Entry, ...]:
        sizes = self.store.sizes()
        found = {name: lines.read_line(self.store, name) for name in names}
        gone = [repr(name) for name, line in found.items() if line is None or sizes.get(line.file) != line.bytes]
        if gone or not names:
            raise DatasetError(f"{self.store.where}: object views are missing: {', '.join(gone[:5])}"
                               f"{', ...' * (len(gone) > 5)}; the dataset cannot be finished. Run `vsfsim generate` "
                               f"again, which makes what is missing.")
        entries = tuple(line for line in found.values() if line is not None)
        for entry in entries:
            if not self._is_whole(entry, sizes):
                lines.forget(self.store, entry.name)
                raise DatasetError(f"{entry.file} was changed after it was written; it was removed. Run `vsfsim "
                                   f"generate` again, which makes what is missing.")
        return entries

    def close(self) -> None:
        """Let go of the folder, finished or not. Safe to call twice."""
        if self._lock is not None:
            release(self._lock)
            self._lock = None

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        # What cannot be made at all (a mesh without volume) leaves no trace; one finished file is worth resuming.
        # A file without its line, of a run that was stopped between the two, is made again by the same command.
        begun = lines.finished_names(self.store) or any(name.endswith(".h5") for name in self.store.sizes())
        if kind is not None and self._fresh and self.shard is None and not begun:
            lines.clear(self.store)
            self.store.remove(PART_MANIFEST)
        self.close()
        if kind is not None and self._made_folder and self.path and self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    # ------------------------------------------------------------------ the start

    def _refuse_other(self) -> None:
        """Refuse a folder that holds something else than a start, or the whole, of this very dataset."""
        files = self.store.sizes()
        code: Any = None
        where = Path(self.store.where)
        if MANIFEST in files:
            there = Dataset.open(self.store.where).recipe
        elif PART_MANIFEST in files:
            table = parse_manifest(self.store.get(PART_MANIFEST) or b"", where / PART_MANIFEST)
            there, code = Recipe.read(table["recipe"], str(where / PART_MANIFEST)), table["made_by"]
        else:
            names = files if self.path is None else [p.name for p in self.path.glob("*")]
            strangers = sorted(name for name in names if name not in (LOCK, lines.FOLDER)
                               and not _OUR_PART.search(name) and not _SHARD_LOCK.fullmatch(name))
            if strangers:
                raise DatasetError(f"folder {where} is not empty and holds no dataset "
                                   f"({', '.join(strangers[:5])}{', ...' if len(strangers) > 5 else ''}). Choose "
                                   f"another --out.")
            return
        differences = there.differences(self.recipe)
        if differences:
            raise DatasetError(f"folder {where} holds another dataset: {'; '.join(differences)}. Choose another "
                               f"--out, or delete that folder first.")
        if code is not None:
            self._check_code(code, "begun")

    def _check_code(self, there: Mapping[str, str | None], done: str) -> None:
        """Refuse to go on with what other code has ``done``."""
        if dict(there) != made_by():
            words = [f"vsfsim {made.get('vsfsim')} at commit {made.get('commit') or 'unknown'}"
                     for made in (there, made_by())]
            raise DatasetError(f"{self.store.where} was {done} by other code: {words[0]} there, {words[1]} here. Files "
                               f"of two versions are not mixed: check out that version to finish it, or delete the "
                               f"folder and start again.")

    def _begin(self) -> dict[str, str | None]:
        self._refuse_other()  # again, now that no other process can write
        self._finished: Dataset | None = None
        files = self.store.sizes()
        if self.path is not None and self.shard is None:
            for part in [*self.path.iterdir(), *(self.path / lines.FOLDER).glob("*")]:
                if _OUR_PART.search(part.name):
                    part.unlink(missing_ok=True)
        if MANIFEST in files:
            finished = Dataset.open(self.store.where)
            if not self._damaged(finished, files):
                self._finished = finished
                if self.shard is None:
                    self.store.remove(PART_MANIFEST)  # killed just before it was removed
                    lines.clear(self.store)
                self.notes.append(f"{self.store.where} is finished already; nothing to do.")
                return dict(finished.made_by)
        if PART_MANIFEST not in files:
            self._fresh = self.store.put_new(PART_MANIFEST, manifest_bytes({
                "format": FORMAT, "schema_version": SCHEMA_VERSION, "made_by": made_by(),
                "recipe": self.recipe.table(), "names": self.names}))
            if not self._fresh:
                self._refuse_other()  # another shard was faster
        self.store.remove(MANIFEST)
        return made_by()

    def _damaged(self, finished: Dataset, files: dict[str, int]) -> bool:
        """Whether files of a finished dataset are missing or damaged; the others get their lines again."""
        bad = [entry for entry in finished.entries if not self._is_whole(entry, files)]
        if not bad and set(finished.names()) | set(finished.left_out) == set(self.names):
            return False
        self._check_code(finished.made_by, "made")
        for entry in finished.entries:
            if entry in bad:
                lines.forget(self.store, entry.name)
                self.notes.append(f"{entry.file} was missing or damaged and is made again.")
            else:
                lines.put_line(self.store, entry, self.recipe)
                self.store.put_new(lines.KIND, entry.made_on.encode())
        return True

    def _is_whole(self, entry: Entry, sizes: dict[str, int]) -> bool:
        """Whether a file is what its line says: by its bytes in a folder, by its size in an object store."""
        return sizes.get(entry.file) == entry.bytes and (self.path is None or
                                                         file_sha256(self.path / entry.file) == entry.sha256)

    def _take_lock(self) -> FileLock | None:
        """A lock on a file of the folder: the system lets go of it when we die, so a stale lock cannot outlive its
        process. Shards have one each; the owner refuses to begin beside them."""
        if self.path is None:
            return None
        if self.shard is None:
            name, others = LOCK, [p for p in self.path.glob("*") if _SHARD_LOCK.fullmatch(p.name)]
        else:
            name, others = f"shard-{self.shard[0]}-of-{self.shard[1]}.lock", [*self.path.glob(LOCK)]
        for other in others:
            release(take(other, self.path, DatasetError)[0])
        lock, before = take(self.path / name, self.path, DatasetError, needed=self.shard is None)
        if before:
            self.notes.append(f"process {before} died while it wrote {self.path}; going on where it stopped.")
        return lock
