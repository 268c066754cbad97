"""A dataset: a folder with dataset.json and one HDF5 file per object view."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import operator
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from vsfsim.core.errors import DatasetError, did_you_mean, no_such_file
from vsfsim.core.interactive.html_table import html_table
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import file_sha256
from vsfsim.data.hdf5 import read_picture, read_shown, read_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.safety import check_file, check_name, whole_number
from vsfsim.data.schema import SCHEMA_VERSION

if TYPE_CHECKING:
    from vsfsim.data.torch_view import TorchView

FORMAT = "vsfsim-dataset"
MANIFEST = "dataset.json"
PART_MANIFEST = "dataset.part.json"
LOCK = "dataset.lock"
LARGEST_MANIFEST = 64 << 20
"""A dataset.json with more bytes is not read."""


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


@dataclass(frozen=True, repr=False)
class Dataset:
    """A finished dataset; object views are read on request.

    ``dataset[3]``, ``dataset[-1]`` and ``dataset["shoe-0004-v0"]`` are object views; ``dataset[:4]`` and
    ``dataset.split("train")`` are datasets of some of them, in the same folder.
    """

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
            if not path.is_dir():
                raise DatasetError(f"{no_such_file('folder of a dataset', path)} `vsfsim generate` makes one.")
            raise DatasetError(f"{path} holds no dataset (there is no {MANIFEST}). Give the folder that `vsfsim "
                               f"generate --out` made.")
        table = read_manifest(manifest)
        return cls(path, Recipe.read(table["recipe"], str(manifest)), table["made_by"],
                   _entries(table["files"], manifest), blind)

    @property
    def sha256(self) -> str:
        """Identity of the content: sha256 over name, split and sha256 of every object file, in order."""
        return content_sha256(self.entries)

    def blind(self) -> Dataset:
        """The same dataset, whose views never show the truth."""
        return dataclasses.replace(self, is_blind=True)

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits, in the order of their first object view."""
        return tuple(dict.fromkeys(entry.split for entry in self.entries))

    def split(self, name: str) -> Dataset:
        """The object views of one split, as a dataset in the same folder.

        Raises:
            DatasetError: no such split.
        """
        names = set(self.names(name))
        return dataclasses.replace(self, entries=tuple(entry for entry in self.entries if entry.name in names))

    def names(self, split: str | None = None) -> tuple[str, ...]:
        """Names of the object views, of one split or of all.

        Raises:
            DatasetError: no such split.
        """
        if split is not None and split not in self.splits:
            raise DatasetError(f"the dataset in {self.path} has no split '{split}'. "
                               f"{did_you_mean(split, self.splits)}")
        return tuple(entry.name for entry in self.entries if split in (None, entry.split))

    def load(self, name: str) -> ObjectView:
        """Read one object view, after its bytes were compared with the sha256 in dataset.json.

        Raises:
            DatasetError: no such name, or the file is missing or damaged.
        """
        path = self._checked_file(name)
        return self._as_listed(read_view(path, blind=self.is_blind), path, name)

    def shown(self, name: str) -> tuple[ObjectView, np.ndarray]:
        """One object view without its truth, and where the small cone was pressed on it, world (P, 3) [m]; nothing else
        of the truth is read.

        Raises:
            DatasetError: as `load`.
        """
        path = self._checked_file(name)
        view, places = read_shown(path)
        return self._as_listed(view, path, name), places

    def picture(self, name: str) -> np.ndarray:
        """The colour image of one object view (H, W, 3) uint8; nothing else of it is read.

        Raises:
            DatasetError: as `load`.
        """
        return read_picture(self._checked_file(name))

    def _as_listed(self, view: ObjectView, path: Path, name: str) -> ObjectView:
        (entry,) = (e for e in self.entries if e.name == name)
        for key in ("name", "split", "object_index", "view_index"):
            if getattr(view, key) != getattr(entry, key):
                raise DatasetError(f"{path} says {key} = {getattr(view, key)!r}, and {MANIFEST} says "
                                   f"{getattr(entry, key)!r}. Delete the folder and generate the dataset again.")
        return view

    def _checked_file(self, name: str) -> Path:
        for entry in self.entries:
            if entry.name == name:
                path = self.path / entry.file
                check_file(path, self.path)
                # HDF5 would read a flipped byte without a word, and a score would rest on it.
                if path.is_file() and file_sha256(path) != entry.sha256:
                    raise DatasetError(f"{path} was changed after it was written (its sha256 does not fit {MANIFEST}). "
                                       f"Delete it and run the same `vsfsim generate` again, which makes only what "
                                       f"is missing.")
                return path
        raise DatasetError(f"the dataset in {self.path} has no object view '{name}'. "
                           f"{did_you_mean(name, self.names())}")

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[ObjectView]:
        return (self.load(entry.name) for entry in self.entries)

    @overload
    def __getitem__(self, key: int | str) -> ObjectView: ...

    @overload
    def __getitem__(self, key: slice) -> Dataset: ...

    def __getitem__(self, key: int | str | slice) -> ObjectView | Dataset:
        """An object view by its number (negative ones count from the end) or name; a dataset for a slice.

        Raises:
            IndexError: there are not so many object views.
            DatasetError: no such name, or the file is missing or damaged.
            TypeError: another kind of key.
        """
        if isinstance(key, slice):
            return dataclasses.replace(self, entries=self.entries[key])
        if isinstance(key, str):
            return self.load(key)
        try:
            number = operator.index(key)
        except TypeError:
            raise TypeError(f"a dataset is indexed by a whole number, a slice or the name of an object view; "
                            f"{key!r} is none of them. `split(name)` gives the views of a split.") from None
        if not -len(self) <= number < len(self):
            raise IndexError(f"the dataset in {self.path} has {len(self)} object views; there is no number {number}.")
        return self.load(self.entries[number].name)

    def __repr__(self) -> str:
        return f"Dataset({str(self.path)!r}: {self._in_words()})"

    def _in_words(self) -> str:
        splits = ", ".join(f"{len(self.names(split))} {split}" for split in self.splits)
        return (f"scene {self.recipe.scene}, {len(self)} object views ({splits}), "
                f"{sum(entry.touches for entry in self.entries)} touches, "
                f"{sum(entry.frames for entry in self.entries)} frames" + ", blind" * self.is_blind)

    def _repr_html_(self) -> str:
        rows = [(k, e.name, e.split, e.touches, e.frames, e.unconverged) for k, e in enumerate(self.entries)]
        return html_table(f"Dataset {self.path}: {self._in_words()}",
                          ("", "object view", "split", "touches", "frames", "not converged"), rows)

    def plot(self, path: str | Path | None = None, *, most: int = 6) -> Any:
        """Draw a contact sheet of the first object views: picture, depth, touched points, force over travel.

        Args:
            path: PNG to write, or None.
            most: object views that are drawn, one a row.

        Returns:
            The `matplotlib.figure.Figure`, which a notebook shows.
        """
        from vsfsim.data.contact_sheet import contact_sheet

        recipe = self.recipe
        return contact_sheet(list(self[:most]), path, title=f"{recipe.scene}, tier {recipe.tier}, seed {recipe.seed}")

    def torch(self, item: str = "touch", **options: Any) -> TorchView:
        """These object views as a `torch.utils.data.Dataset`; see `vsfsim.data.torch_view.TorchView`.

        Args:
            item: "touch" or "view": what one item is.
            options: of `TorchView`.
        """
        from vsfsim.data.torch_view import TorchView

        return TorchView(self, item, **options)


def load(folder: str | Path, *, blind: bool = False) -> Dataset:
    """Open a dataset; `vsfsim.load` is this function.

    Args:
        folder: what `vsfsim generate --out` made.
        blind: whether object views come without their truth.

    Raises:
        DatasetError: no dataset there, an unfinished or a damaged one, or one of another schema version.
    """
    return Dataset.open(folder, blind=blind)


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
        if path.stat().st_size > LARGEST_MANIFEST:
            raise ValueError(f"it has more than {LARGEST_MANIFEST} bytes")
        content = path.read_bytes()
        table = json.loads(content)
        format_ = table["format"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DatasetError(f"{path} cannot be read as a dataset's manifest: {plain(repr(error))}. It is damaged; "
                           f"delete the folder and generate the dataset again, or restore the file.") from error
    if format_ != FORMAT:
        raise DatasetError(f"{path} is not the manifest of a vsfsim dataset (format "
                           f"{plain(repr(format_), longest=60)}).")
    if table.get("schema_version") != SCHEMA_VERSION:
        raise DatasetError(f"{path} has schema version {plain(table.get('schema_version'), longest=60)}; this vsfsim "
                           f"reads {SCHEMA_VERSION}. Use the vsfsim version it names under made_by, or generate it "
                           f"again.")
    try:
        whole = manifest_bytes(table) == content
    except (ValueError, RecursionError):
        whole = False
    if not whole:
        raise DatasetError(f"{path} was changed after it was written (its digest does not fit). Restore the file, or "
                           f"delete the folder and run the same `vsfsim generate` again.")
    for key in ("made_by", "recipe", "files"):
        if key not in table and not (path.name == PART_MANIFEST and key == "files"):
            raise DatasetError(f"{path} has no '{key}'; it is damaged.")
    if not isinstance(table["made_by"], dict):
        raise DatasetError(f"{path}: made_by is {plain(table['made_by'], longest=60)}; it must be a table.")
    return table


def _entries(rows: Any, path: Path) -> tuple[Entry, ...]:
    """The entries of ``files``, none of them twice, and no object in two splits."""
    if not isinstance(rows, list) or not rows:
        raise DatasetError(f"{path}: files is {plain(rows, longest=60)}; it must be a list of at least one entry.")
    entries = tuple(_entry(row, path) for row in rows)
    for what, keys in (("name", [e.name for e in entries]), ("file", [e.file for e in entries]),
                       ("object and view", [(e.object_index, e.view_index) for e in entries]),
                       ("content", [e.sha256 for e in entries])):
        twice = [key for key, count in Counter(keys).items() if count > 1]
        if twice:
            raise DatasetError(f"{path}: the {what} {twice[0]} is there twice; a dataset holds everything once. Delete "
                               f"the folder and generate it again.")
    splits: dict[int, str] = {}
    for entry in entries:
        if splits.setdefault(entry.object_index, entry.split) != entry.split:
            raise DatasetError(f"{path}: object {entry.object_index} is in the splits {splits[entry.object_index]} and "
                               f"{entry.split}; an object belongs to one.")
    return entries


def _entry(row: Any, path: Path) -> Entry:
    names = {f.name for f in dataclasses.fields(Entry)}
    if not isinstance(row, Mapping) or set(row) != names:
        raise DatasetError(f"{path}: an entry of files is {plain(row, longest=200)}; it must have "
                           f"{', '.join(sorted(names))}.")
    where = f"{path} files"
    for key in ("object_index", "view_index", "touches", "frames", "unconverged", "bytes"):
        whole_number(row[key], f"{where}.{key}")
    for key in ("name", "file", "split", "sha256"):
        check_name(row[key], f"{where}.{key}")
    return Entry(**row)
