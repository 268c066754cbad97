"""Finished datasets to copy instead of making them: everybody makes the same bits.

``$VSFSIM_ARCHIVE`` names a folder, or an address of an object store, that holds datasets by the names of their folders.
A copy is taken only if its content has the digest that ships in a record of a task (``tasks/records``), so that whoever
keeps the archive need not be trusted.
"""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Callable
from pathlib import Path

from vsfsim.core import shelf
from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import whole_folder
from vsfsim.data.manifest import MANIFEST, content_sha256, entries_of, parse_manifest
from vsfsim.data.store import Store

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
    store, said = Store(origin), note or (lambda _: None)
    manifest = store.get(MANIFEST)
    if manifest is None:
        return None
    spot = Path(origin) / MANIFEST
    entries = entries_of(parse_manifest(manifest, spot)["files"], spot)
    if (found := content_sha256(entries)) not in digests:
        said(f"{origin} holds another dataset than the record of its task ({found[:12]}, not "
             f"{', '.join(sorted(d[:12] for d in digests))}); it is not taken")
        return None
    with whole_folder(folder) as part:
        for done, entry in enumerate(entries):
            if progress is not None:
                progress(done, len(entries), entry.file)
            content = store.get(entry.file)
            if content is None or hashlib.sha256(content).hexdigest() != entry.sha256:
                raise DatasetError(f"{origin}/{entry.file} is missing or is not the file that its dataset.json names. "
                                   f"Mend the archive, or unset {VARIABLE} to make the dataset here.")
            (part / entry.file).write_bytes(content)
        (part / MANIFEST).write_bytes(manifest)
    said(f"taken from {origin} with the digest of the task's record; unset {VARIABLE} to make it here")
    return Dataset.open(folder)
