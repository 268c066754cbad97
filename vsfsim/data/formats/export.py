"""`vsfsim lab export`: a dataset in another format, whole or not at all; and what the formats share, which are tables,
pictures and the truth as a table."""

from __future__ import annotations

import importlib
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import one_of
from vsfsim.core.extras import require
from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.disk import whole_folder
from vsfsim.data.formats.archive import write_archive
from vsfsim.data.records import ObjectView, values_of
from vsfsim.data.schema import fields_of

FORMATS = ("lerobot", "croissant", "webdataset", "openvsf", "archive")


def export(folder: str | Path, to: str, out: str | Path, progress: Progress | None = None) -> Path:
    """Write a finished dataset in another format.

    Args:
        folder: of the dataset, or its address.
        to: one of `FORMATS`.
        out: the new folder; of an archive the folder that it is put into, among others.
        progress: called with (views done, of how many, name).

    Returns:
        The new folder, or the archive.

    Raises:
        VsfsimError: no finished dataset, no such format, the folder exists, a package is missing, or the disk refuses.
    """
    one_of(to, FORMATS, "--to")
    dataset, path = Dataset.open(folder, progress=progress), Path(out)
    if to == "archive":
        return write_archive(dataset, path)
    with whole_folder(path) as part:
        importlib.import_module(f"vsfsim.data.formats.{to}").export(dataset, part)
    return path


def arrow() -> Any:
    """pyarrow, with its parquet writer.

    Raises:
        MissingPackage: it is not installed.
    """
    require("export", "pyarrow")
    import pyarrow
    import pyarrow.parquet

    return pyarrow


def png(image: np.ndarray) -> bytes:
    """A picture as PNG: sRGB (H, W, 3), or grey and opacity (H, W, 2), uint8.

    Raises:
        MissingPackage: Pillow is not installed.
    """
    require("render", "PIL")
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(out, format="PNG")
    return out.getvalue()


def write_table(path: Path, columns: Mapping[str, Any], *, index: str = "") -> None:
    """Write a parquet file.

    Args:
        path: of the file. columns: arrays, lists, or arrays of pyarrow by name. index: a column that pandas takes for
        the names of the rows.
    """
    pa = arrow()
    table = pa.table(dict(columns))
    if index:
        rows = [{"name": name, "field_name": name, "pandas_type": "unicode" if name == index else "int64",
                 "numpy_type": "object" if name == index else "int64", "metadata": None} for name in columns]
        table = table.replace_schema_metadata({"pandas": json.dumps({
            "index_columns": [index], "column_indexes": [], "columns": rows, "creator": {
                "library": "pyarrow", "version": pa.__version__}, "pandas_version": "2.0.0"})})
    path.parent.mkdir(parents=True, exist_ok=True)
    pa.parquet.write_table(table, path, compression="zstd")


def columns_of(names: Iterable[str], rows: Sequence[Sequence[Any]]) -> dict[str, list[Any]]:
    """Rows as columns, each under its name."""
    return {name: [row[k] for row in rows] for k, name in enumerate(names)}


def fixed(values: np.ndarray) -> Any:
    """Rows (T, k) as a parquet column of lists of one length, or (T,) as a plain one."""
    pa = arrow()
    values = np.asarray(values)
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), values.shape[1])


def truth_columns(views: Sequence[ObjectView]) -> dict[str, Any]:
    """The truth of some views, one row each: every field of the schema as a flat list beside its shape."""
    held = [{} if view.truth is None else values_of(view.truth) for view in views]
    out: dict[str, Any] = {"view": [view.name for view in views]}
    for field in fields_of("truth"):
        arrays = [np.asarray(values[field.name]) if field.name in values else None for values in held]
        out[field.name] = [None if a is None else a.reshape(-1).tolist() for a in arrays]
        out[f"{field.name}_shape"] = [None if a is None else list(a.shape) for a in arrays]
    return out
