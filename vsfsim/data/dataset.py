"""A dataset: a folder with dataset.json and one HDF5 file per object view."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from vsfsim.core.errors import DatasetError, no_such_file, one_of
from vsfsim.core.system.interactive import html_table
from vsfsim.data.disk import Store, is_url, write_atomic
from vsfsim.data.hdf5 import fault_of, read_shown, read_view
from vsfsim.data.manifest import (
    LARGEST_MANIFEST,
    MANIFEST,
    PART_MANIFEST,
    Entry,
    content_sha256,
    entries_of,
    parse_manifest,
)
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView

if TYPE_CHECKING:
    from vsfsim.data.torch_view import TorchView

Progress = Callable[[int, int, str], None]


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
    left_out: Mapping[str, str] = field(default_factory=dict)
    """Object views that could not be made, with the reason."""
    origin: str = ""
    """Address of the object store that files are fetched from when they are read; "" where `path` has them all."""

    progress: Progress | None = field(default=None, compare=False)
    """Called with (its number, of how many, name) when an object view is read, or None."""

    @classmethod
    def open(cls, path: str | Path, *, blind: bool = False, progress: Progress | None = None) -> Dataset:
        """Open the dataset in folder ``path``, or at an address of an object store. Only dataset.json is read now.

        Files of an object store are fetched one by one when they are read, into $VSFSIM_FETCHED or the user's cache.

        Raises:
            DatasetError: no dataset there, an unfinished or a damaged one, or one of another schema version.
        """
        origin = str(path) if is_url(path) else ""
        if not origin and not Path(path).is_dir():
            raise DatasetError(f"{no_such_file('folder of a dataset', path)} `vsfsim generate` makes one.")
        store = Store(path)
        if (content := store.get(MANIFEST, most=LARGEST_MANIFEST + 1)) is None:
            if PART_MANIFEST in store.sizes():
                raise DatasetError(f"the dataset in {path} is unfinished. Run the same `vsfsim generate` again; it "
                                   f"makes only what is missing.")
            raise DatasetError(f"{path} holds no dataset (there is no {MANIFEST}). Give the folder that `vsfsim "
                               f"generate --out` made.")
        path = Path(path)
        if origin:
            root = Path(os.environ.get("VSFSIM_FETCHED") or Path.home() / ".cache" / "vsfsim" / "fetched")
            path = root / hashlib.sha256(content).hexdigest()[:32]
            write_atomic(path / MANIFEST, content)
        manifest = path / MANIFEST
        table = parse_manifest(content, manifest)
        return cls(path, Recipe.read(table["recipe"], str(manifest)), table["made_by"],
                   entries_of(table["files"], manifest), blind, table["left_out"], origin, progress)

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
        if split is not None:
            one_of(split, self.splits, f"the split of {self.path}", DatasetError)
        return tuple(entry.name for entry in self.entries if split in (None, entry.split))

    def load(self, name: str) -> ObjectView:
        """Read one object view, after its bytes were compared with the sha256 in dataset.json.

        Raises:
            DatasetError: no such name, or the file is missing or damaged.
        """
        entry, path = self.checked_file(name)
        if self.progress is not None:
            self.progress(self.names().index(name), len(self), name)
        return _as_listed(read_view(path, blind=self.is_blind), path, entry)

    def shown(self, name: str) -> tuple[ObjectView, np.ndarray]:
        """One object view without its truth, and where the small cone was pressed on it, world (P, 3) [m]; nothing else
        of the truth is read.

        Raises:
            DatasetError: as `load`.
        """
        entry, path = self.checked_file(name)
        view, places = read_shown(path)
        return _as_listed(view, path, entry), places

    def checked_file(self, name: str) -> tuple[Entry, Path]:
        """The entry of an object view and its file, after its bytes were compared with the sha256.

        Raises:
            DatasetError: as `load`.
        """
        names = self.names()
        entry = self.entries[names.index(one_of(name, names, f"the object view of {self.path}", DatasetError))]
        path = self.path / entry.file
        if self.origin and not path.is_file():
            content = Store(self.origin).get(entry.file)
            if content is None:
                raise DatasetError(f"{self.origin}/{entry.file} does not exist. Run the same `vsfsim generate` again; "
                                   f"it makes only what is missing.")
            write_atomic(path, content)
        # HDF5 would read a flipped byte without a word, and a score would rest on it.
        if (fault := fault_of(path, entry.sha256)) is not None:
            raise DatasetError(f"{path} {' '.join(fault)}")
        return entry, path

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
            entry = self.entries[key]
        except IndexError:
            raise IndexError(f"the dataset in {self.path} has {len(self)} object views; there is no number "
                             f"{key}.") from None
        return self.load(entry.name)

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
            item: "touch", "view" or "object" (a view with its touches): what one item is.
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


def _as_listed(view: ObjectView, path: Path, entry: Entry) -> ObjectView:
    for key in ("name", "split", "object_index", "view_index"):
        if getattr(view, key) != getattr(entry, key):
            raise DatasetError(f"{path} says {key} = {getattr(view, key)!r}, and {MANIFEST} says "
                               f"{getattr(entry, key)!r}. Delete the folder and generate the dataset again.")
    return view
