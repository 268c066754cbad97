"""Finished datasets to copy instead of making them: everybody makes the same bits.

``$VSFSIM_ARCHIVE`` names a folder, or an address of an object store, that holds datasets by the names of their folders.
A copy is taken only if its content has the digest that ships in a record of a task (``tasks/records``), so that whoever
keeps the archive need not be trusted.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tomllib
import uuid
from collections.abc import Callable
from pathlib import Path

from vsfsim.core import shelf
from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.data.manifest import MANIFEST
from vsfsim.data.store import open_store

VARIABLE = "VSFSIM_ARCHIVE"


def digests_of(name: str) -> set[str]:
    """Digests of the content of the dataset that tasks look for in a folder of this name."""
    found = set()
    for task, path in shelf.tasks().items():
        record = shelf.folder("tasks") / "records" / f"{task}.json"
        if tomllib.loads(path.read_text(encoding="utf-8"))["dataset"]["folder"] == name and record.is_file():
            found.add(json.loads(record.read_text())["dataset_sha256"])
    return found


def taken(folder: Path, name: str, *, progress: Callable[[int, int, str], None] | None = None,
          note: Callable[[str], None] | None = None) -> Dataset | None:
    """A dataset, copied from the archive into ``folder``, which does not exist.

    Args:
        folder: to be made. name: under which a task looks for the dataset. progress: called with (files copied, of how
        many, which). note: called with a sentence on where it came from, or why none was taken.

    Returns:
        The dataset; None where no archive is configured, or it holds no dataset with a digest of a task's record.

    Raises:
        DatasetError: a file of the archive is not what its dataset.json says, or cannot be read or written.
    """
    archive = os.environ.get(VARIABLE, "")
    digests = digests_of(name) if archive else set()
    if not digests or folder.exists():
        return None
    origin = f"{archive.rstrip('/')}/{name}"
    store, said = open_store(origin), note or (lambda _: None)
    manifest = store.get(MANIFEST)
    if manifest is None:
        return None
    part = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}")
    try:
        part.mkdir(parents=True)
    except OSError as error:
        raise DatasetError(f"folder {part} cannot be made: {error.strerror}. Choose another --out.") from error
    try:
        write_atomic(part / MANIFEST, manifest)
        dataset = Dataset.open(part)
        if dataset.sha256 not in digests:
            said(f"{origin} holds another dataset than the record of its task ({dataset.sha256[:12]}, not "
                 f"{', '.join(sorted(d[:12] for d in digests))}); it is not taken")
            return None
        for done, entry in enumerate(dataset.entries):
            if progress is not None:
                progress(done, len(dataset.entries), entry.file)
            content = store.get(entry.file)
            if content is None or hashlib.sha256(content).hexdigest() != entry.sha256:
                raise DatasetError(f"{origin}/{entry.file} is missing or is not the file that its dataset.json names. "
                                   f"Mend the archive, or unset {VARIABLE} to make the dataset here.")
            write_atomic(part / entry.file, content)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    said(f"taken from {origin} with the digest of the task's record; unset {VARIABLE} to make it here")
    return Dataset.open(folder)
