"""A finished dataset as one file, from which `vsfsim generate` and `vsfsim evaluate` take it instead of making it.

An archive is a zip file with every byte of the folder. Its name says what it is an archive of, so that one folder, or
one address, holds those of many datasets.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import file_stem, plain
from vsfsim.core.shelf import folder
from vsfsim.core.system import file_lock
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import Store, whole_folder, write_atomic
from vsfsim.data.manifest import CARD, MANIFEST, card
from vsfsim.data.recipe import text_sha256
from vsfsim.data.safety import LARGEST_RATIO, SMALL, check_name
from vsfsim.data.verify import verify

VARIABLE = "VSFSIM_ARCHIVES"
"""Environment variable that names a folder or an address with archives. Those that ship are looked at after it, and
none at all where it is empty."""
_USUAL = {"device": "cpu", "renderer": "warp", "options": {}, "files": {}}
"""What of a recipe no task names, with the values of nearly all recipes."""


def archive_name(asked: Any) -> str:
    """Name of the archive of a dataset.

    Args:
        asked: its `vsfsim.data.recipe.Recipe`, or the ``[dataset]`` of a task.
    """
    what = [asked.scene, asked.scene_sha256, asked.seed, asked.objects, asked.views, asked.touches]
    what += [asked.tier, *(getattr(asked, key, usual) for key, usual in _USUAL.items())]
    return f"{file_stem(asked.scene)}-{text_sha256(json.dumps(what, sort_keys=True))[:16]}.zip"


def write_archive(dataset: Dataset, where: Path) -> Path:
    """Write the archive of a dataset into the folder ``where``; the same dataset gives the same bytes. All of it is in
    memory for a moment.

    Raises:
        DatasetError: a file of the dataset is missing or damaged, or the disk refuses.
    """
    paths = [dataset.checked_file(name)[1] for name in dataset.names()]
    about = card(dataset.recipe, dataset.made_by, dataset.entries, dataset.left_out).encode()
    with zipfile.ZipFile(buffer := io.BytesIO(), "w", zipfile.ZIP_LZMA) as packed:
        packed.writestr(zipfile.ZipInfo(CARD), about)  # of no time
        for path in (dataset.path / MANIFEST, *paths):
            packed.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_LZMA)
    write_atomic(path := where / archive_name(dataset.recipe), buffer.getvalue())
    return path


def unpack(asked: Any, path: Path, note: Callable[[str], None]) -> None:
    """Unpack the archive of a dataset as the folder ``path``, whole or not at all, if there is one and no such folder.

    Args:
        asked: as of `archive_name`.
        path: folder of the dataset.
        note: called with a sentence on what was unpacked, or is not where it was looked for.

    Raises:
        DatasetError: an archive cannot be read, or what it holds is damaged or another dataset.
    """
    said, name = os.environ.get(VARIABLE), archive_name(asked)
    for place in () if said == "" or path.exists() else (said, folder("tasks") / "archives"):
        if place is None or (content := Store(place).get(name)) is None:
            continue
        lock, _ = file_lock.take(path.parent / f".{path.name}.lock", path, DatasetError, wait=True)
        try:
            if not path.exists():  # of several processes that begin at once one unpacks
                with whole_folder(path) as part:
                    _fill(part, content, f"{place}/{name}")
                note(f"{path} is unpacked from {place}/{name}")
            return
        finally:
            file_lock.release(lock)
    if said and not path.exists():
        note(f"{said} has no {name}")


def _fill(part: Path, content: bytes, archive: str) -> None:
    """Unpack ``content`` into the folder ``part``, and look whether it is the dataset that its name says."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as packed:
            size = sum(file.file_size for file in packed.infolist() if check_name(file.filename, "it"))
            if size > SMALL + LARGEST_RATIO * len(content):
                raise DatasetError(f"it announces {size / 1e6:.0f} MB and has {len(content) / 1e6:.1f} MB")
            packed.extractall(part)
        problems, there = verify(part).problems, Dataset.open(part).recipe
        if problems or archive_name(there) != Path(archive).name:
            raise DatasetError(f"{problems[0].file} {problems[0].what}" if problems else
                               f"it holds another dataset, of scene {there.scene} and seed {there.seed}")
    except Exception as error:  # of a damaged file zipfile raises many kinds
        if isinstance(error, OSError) and error.errno:  # of the disk
            raise
        raise DatasetError(f"archive {archive} is not taken: {plain(error).rstrip('.')}. Copy it again, "
                           f"delete it, or set {VARIABLE} to nothing.") from error
