"""Copies of files of an object store, made when they are read."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from vsfsim.core.errors import DatasetError
from vsfsim.data.disk import write_atomic
from vsfsim.data.manifest import MANIFEST, PART_MANIFEST
from vsfsim.data.store import open_store


def fetched_folder(digest: str) -> Path:
    """Where files of a dataset in an object store are kept: under $VSFSIM_FETCHED, else in the user's cache."""
    root = os.environ.get("VSFSIM_FETCHED") or Path.home() / ".cache" / "vsfsim" / "fetched"
    return Path(root) / digest


def fetch(origin: str, name: str, path: Path) -> None:
    """Copy one file of an object store to ``path``, whole or not at all.

    Raises:
        DatasetError: it is not there, or cannot be read or written.
    """
    content = open_store(origin).get(name)
    if content is None:
        raise DatasetError(f"{origin}/{name} does not exist. Run the same `vsfsim generate` again; it makes only what "
                           f"is missing.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content)


def fetch_manifest(origin: str) -> Path:
    """Copy dataset.json of an object store into the folder that its content names, which is returned.

    Raises:
        DatasetError: no finished dataset there.
    """
    store = open_store(origin)
    content = store.get(MANIFEST)
    if content is None:
        unfinished = store.get(PART_MANIFEST) is not None
        raise DatasetError(f"the dataset at {origin} is unfinished. Run `vsfsim generate --finish` when all shards are "
                           f"done." if unfinished else f"{origin} holds no dataset (there is no {MANIFEST}).")
    path = fetched_folder(hashlib.sha256(content).hexdigest()[:32])
    path.mkdir(parents=True, exist_ok=True)
    write_atomic(path / MANIFEST, content)
    return path
