"""`vsfsim export`: a dataset in another format, whole or not at all."""

from __future__ import annotations

import importlib
from pathlib import Path

from vsfsim.core.errors import VsfsimError, did_you_mean
from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.disk import whole_folder

FORMATS = ("lerobot", "croissant", "webdataset", "openvsf")


def export(folder: str | Path, to: str, out: str | Path, progress: Progress | None = None) -> Path:
    """Write a finished dataset in another format.

    Args:
        folder: of the dataset, or its address.
        to: one of `FORMATS`.
        out: the new folder.
        progress: called with (views done, of how many, name).

    Returns:
        The new folder.

    Raises:
        VsfsimError: no finished dataset, no such format, the folder exists, a package is missing, or the disk refuses.
    """
    if to not in FORMATS:
        raise VsfsimError(f"--to is '{to}'. {did_you_mean(to, FORMATS)}")
    dataset, path = Dataset.open(folder, progress=progress), Path(out)
    with whole_folder(path) as part:
        importlib.import_module(f"vsfsim.data.formats.{to}").export(dataset, part)
    return path
