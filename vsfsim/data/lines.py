"""The manifest of a dataset that is being made: one line, a small file, for every object view that is finished.

    manifest/NAME.json    file, bytes, sha256, seed and kind of machine; written when the object file lies there whole
    manifest/kind         the kind of machine that finished a view first
    manifest/NAME.failed  how often making this view has failed, and why; of runs that allow `poison`

Any number of machines may write at the same time: all of them would write the same bytes.
"""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass
from pathlib import Path

import msgspec

from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import Store
from vsfsim.data.hdf5 import encode_view
from vsfsim.data.manifest import Entry, entry_of, file_name
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView

FOLDER = "manifest"
KIND = f"{FOLDER}/kind"
_LINE, _FAILED, TOUCH = ".json", ".failed", ".touch"
MOST_FAILURES = 2
"""A view that failed so often is not tried again in a run that allows `poison`."""


def put_view(store: Store, view: ObjectView, recipe: Recipe, made_on: str) -> Entry:
    """Write a finished object view and then its line.

    Args:
        store: of the dataset. view: with its truth. recipe: of the dataset. made_on: kind of machine.

    Raises:
        DatasetError: a field does not fit the schema, or the store refuses.
    """
    content = encode_view(view)
    entry = entry_of(view, content, made_on)
    store.put(entry.file, content)
    put_line(store, entry, recipe)
    return entry


def put_line(store: Store, entry: Entry, recipe: Recipe) -> None:
    """Write the line of an object file that lies there whole."""
    store.put(f"{FOLDER}/{entry.name}{_LINE}", json.dumps({**entry.table(), "seed": recipe.seed}).encode())


def finished_names(store: Store) -> set[str]:
    """Names of the object views whose line is there; one listing."""
    return {name.removesuffix(_LINE) for name in store.sizes(FOLDER) if name.endswith(_LINE)}


def read_line(store: Store, name: str) -> Entry | None:
    """The line of an object view, None if it is not there or not whole."""
    with contextlib.suppress(msgspec.DecodeError):
        return msgspec.json.decode(store.get(f"{FOLDER}/{name}{_LINE}") or b"", type=Entry)
    return None


def forget(store: Store, name: str) -> None:
    """Count an object view as not made: its line goes first, then its file."""
    store.remove(f"{FOLDER}/{name}{_LINE}")
    store.remove(file_name(name))


def check_kind(store: Store, made_on: str, *, mixed: bool) -> None:
    """Refuse to make views on another kind of machine than the one that began, unless ``mixed``.

    Raises:
        DatasetError: it is another one.
    """
    if not (found := store.get(KIND)) and not store.put_new(KIND, made_on.encode()):
        found = store.get(KIND)
    there = (found or b"").decode(errors="replace") or made_on
    if there != made_on and not mixed:
        raise DatasetError(f"{store.where} was begun on '{plain(there)}', and this machine is '{made_on}': they round "
                           f"otherwise, so that another machine could not make the same bytes again. Run it on "
                           f"machines of one kind, or give --allow mixed; each file then says what made it.")


@dataclass(frozen=True)
class Failure:
    """What is known of an object view that could not be made."""

    count: int = 0
    """How often it has failed, or its process has died."""
    reason: str = ""
    """Of the last time."""


def failure(store: Store, name: str) -> Failure:
    """The failures of an object view so far."""
    with contextlib.suppress(msgspec.DecodeError):
        return msgspec.json.decode(store.get(f"{FOLDER}/{name}{_FAILED}") or b"", type=Failure)
    return Failure()


def put_failure(store: Store, name: str, found: Failure) -> None:
    """Keep the failures of an object view; none removes them."""
    spot = f"{FOLDER}/{name}{_FAILED}"
    if found.count:
        store.put(spot, msgspec.json.encode(found))
    else:
        store.remove(spot)


def poisoned(store: Store) -> dict[str, str]:
    """Object views that have failed `MOST_FAILURES` times, with the reason."""
    names = (name.removesuffix(_FAILED) for name in store.sizes(FOLDER) if name.endswith(_FAILED))
    found = {name: failure(store, name) for name in sorted(names)}
    return {name: one.reason for name, one in found.items() if one.count >= MOST_FAILURES}


def clear(store: Store) -> None:
    """Remove the manifest of a finished dataset."""
    for name in store.sizes(FOLDER):
        store.remove(f"{FOLDER}/{name}")
    folder = Path(store.where) / FOLDER
    if folder.is_dir():
        folder.rmdir()
