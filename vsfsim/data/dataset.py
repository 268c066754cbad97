"""A dataset: a folder with dataset.json and one HDF5 file per object view."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError, did_you_mean
from vsfsim.data.disk import file_sha256
from vsfsim.data.hdf5 import read_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.schema import SCHEMA_VERSION

FORMAT = "vsfsim-dataset"
MANIFEST = "dataset.json"
PART_MANIFEST = "dataset.part.json"
LOCK = "dataset.lock"


@dataclass(frozen=True)
class Entry:
    """One object file as dataset.json lists it."""

    name: str
    """Of the object view."""
    file: str
    """File name."""
    split: str
    """"train", "test", ..."""
    object_index: int
    """From 0."""
    view_index: int
    """Of the view of that object, from 0."""
    touches: int
    """Number of touches."""
    frames: int
    """Of all touches."""
    unconverged: int
    """Frames that are marked as not converged."""
    bytes: int
    """Size of the file."""
    sha256: str
    """Of the file."""


@dataclass(frozen=True)
class Dataset:
    """A finished dataset; object views are read on request."""

    path: Path
    """The folder."""
    recipe: Recipe
    """What it was made from."""
    made_by: Mapping[str, str | None]
    """Version and commit."""
    entries: tuple[Entry, ...]
    """Its object files, in order."""
    is_blind: bool = False
    """Whether views come without their truth."""

    @classmethod
    def open(cls, path: str | Path, *, blind: bool = False) -> Dataset:
        """Open the dataset in folder ``path``. Only dataset.json is read now.

        Raises:
            DatasetError: no dataset there, an unfinished or a damaged one, or one of another schema version.
        """
        path = Path(path)
        manifest = path / MANIFEST
        if not manifest.is_file():
            if (path / PART_MANIFEST).is_file():
                raise DatasetError(f"the dataset in {path} is unfinished. Run the same `vsfsim generate` again; it "
                                   f"makes only what is missing.")
            raise DatasetError(f"{path} holds no dataset (there is no {MANIFEST}). Give the folder that `vsfsim "
                               f"generate --out` made.")
        table = read_manifest(manifest)
        entries = tuple(_entry(row, manifest) for row in table["files"])
        return cls(path, Recipe.read(table["recipe"], str(manifest)), table["made_by"], entries, blind)

    @property
    def sha256(self) -> str:
        """Identity of the content: sha256 over name, split and sha256 of every object file, in order."""
        return content_sha256(self.entries)

    def blind(self) -> Dataset:
        """The same dataset, whose views never show the truth."""
        return dataclasses.replace(self, is_blind=True)

    def names(self, split: str | None = None) -> tuple[str, ...]:
        """Names of the object views, of one split or of all.

        Raises:
            DatasetError: no such split.
        """
        splits = list(dict.fromkeys(entry.split for entry in self.entries))
        if split is not None and split not in splits:
            raise DatasetError(f"the dataset in {self.path} has no split '{split}'. {did_you_mean(split, splits)}")
        return tuple(entry.name for entry in self.entries if split in (None, entry.split))

    def load(self, name: str) -> ObjectView:
        """Read one object view, after its bytes were compared with the sha256 in dataset.json.

        Raises:
            DatasetError: no such name, or the file is missing or damaged.
        """
        for entry in self.entries:
            if entry.name == name:
                path = self.path / entry.file
                # HDF5 would read a flipped byte without a word, and a score would rest on it.
                if path.is_file() and file_sha256(path) != entry.sha256:
                    raise DatasetError(f"{path} was changed after it was written (its sha256 does not fit {MANIFEST}). "
                                       f"Delete it and run the same `vsfsim generate` again, which makes only what "
                                       f"is missing.")
                return read_view(self.path / entry.file, blind=self.is_blind)
        raise DatasetError(f"the dataset in {self.path} has no object view '{name}'. "
                           f"{did_you_mean(name, self.names())}")

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[ObjectView]:
        return (self.load(entry.name) for entry in self.entries)


def content_sha256(entries: tuple[Entry, ...]) -> str:
    """See `Dataset.sha256`."""
    lines = "".join(f"{entry.name} {entry.split} {entry.sha256}\n" for entry in entries)
    return hashlib.sha256(lines.encode()).hexdigest()


def file_name(name: str) -> str:
    """File of the object view ``name``."""
    return f"{name}.h5"


def manifest_bytes(table: Mapping[str, Any]) -> bytes:
    """dataset.json as bytes; its first key ``digest`` is the sha256 of all the others, so that no byte can change
    unseen."""
    body = {key: value for key, value in table.items() if key != "digest"}
    digest = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    return (json.dumps({"digest": digest, **body}, indent=1) + "\n").encode()


def make_manifest(recipe: Recipe, made_by: Mapping[str, str | None], entries: tuple[Entry, ...]) -> bytes:
    """dataset.json of a finished dataset; no times and no paths, so that a second run gives the same bytes."""
    return manifest_bytes({"format": FORMAT, "schema_version": SCHEMA_VERSION, "made_by": dict(made_by),
                           "sha256": content_sha256(entries), "recipe": recipe.table(),
                           "files": [dataclasses.asdict(entry) for entry in entries]})


def read_manifest(path: Path) -> dict[str, Any]:
    """Read a dataset.json and check that it is whole.

    Raises:
        DatasetError: not readable, changed since it was written, or of another schema version.
    """
    try:
        content = path.read_bytes()
        table = json.loads(content)
        format_ = table["format"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path} cannot be read as a dataset's manifest: {error!r}. It is damaged; delete the "
                           f"folder and generate the dataset again, or restore the file.") from error
    if format_ != FORMAT:
        raise DatasetError(f"{path} is not the manifest of a vsfsim dataset (format {format_!r}).")
    if table.get("schema_version") != SCHEMA_VERSION:
        raise DatasetError(f"{path} has schema version {table.get('schema_version')}; this vsfsim reads "
                           f"{SCHEMA_VERSION}. Use the vsfsim version it names under made_by, or generate it again.")
    if manifest_bytes(table) != content:
        raise DatasetError(f"{path} was changed after it was written (its digest does not fit). Restore the file, or "
                           f"delete the folder and run the same `vsfsim generate` again.")
    for key in ("made_by", "recipe", "files"):
        if key not in table and not (path.name == PART_MANIFEST and key == "files"):
            raise DatasetError(f"{path} has no '{key}'; it is damaged.")
    return table


def _entry(row: Any, path: Path) -> Entry:
    names = {f.name for f in dataclasses.fields(Entry)}
    if not isinstance(row, Mapping) or set(row) != names:
        raise DatasetError(f"{path}: an entry of files is {row!r}; it must have {', '.join(sorted(names))}.")
    return Entry(**row)
