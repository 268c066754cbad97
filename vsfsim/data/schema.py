"""The one table of what an object file holds, `schema.md` beside this file, which docs/dataset.md includes; writer,
reader and verifier are made from it. Its rows without ``*`` are the fields of the records (`vsfsim.data.records`).

A path is relative to the root of the HDF5 file; ``*`` stands for the three-digit number of a touch. A dimension is a
number, or a letter whose length must agree wherever it occurs within the view, within one touch, or within the truth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vsfsim.core.errors import DatasetError

FORMAT = "vsfsim-object-view"
SCHEMA_VERSION = 1
TEXT = "text"
"""dtype of a row of strings: UTF-8, padded with zero bytes to the longest."""
CHANNELS = "channels/"
"""What the names of a touch's readings begin with that have no field of their own."""


@dataclass(frozen=True)
class Field:
    """One HDF5 dataset."""

    path: str
    """In the file."""
    dtype: str
    """NumPy name, or `TEXT`."""
    dims: tuple[str, ...]
    """Lengths or letters, outermost first."""
    unit: str
    """Of the stored numbers; "1" is dimensionless."""
    doc: str
    """One sentence."""
    required: bool = True
    """False where the record may hold None."""
    masked: bool = False
    """Along T, only the rows of converged frames must be finite."""

    @classmethod
    def of_channel(cls, name: str, dtype: str, attributes: Mapping[str, object], where: str) -> Field:
        """The row of a channel that another package recorded, from what its file says of it.

        Args:
            name: within a touch, "channels/NAME". dtype: NumPy name. attributes: of the HDF5 dataset. where: file and
            path, for the message.

        Raises:
            DatasetError: it is not described.
        """
        short = name.removeprefix(CHANNELS)
        said = {key: attributes.get(key) for key in ("units", "dims", "doc", "masked")}
        units, dims, doc = said["units"], said["dims"], said["doc"]
        words = dims.split() if isinstance(dims, str) and dims != "scalar" else []
        if not (re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", short) and isinstance(units, str) and isinstance(doc, str)
                and isinstance(dims, str) and dims and said["masked"] in (0, 1)
                and all(re.fullmatch(r"[A-Za-z]|[0-9]{1,9}", word) for word in words)):
            raise DatasetError(f"{where} is not in the schema, and its attributes do not describe it: a channel of "
                               f"another package has units, dims, doc and masked. Install that package, or generate "
                               f"the dataset again with one that gives its channel a row.")
        return cls(f"touches/*/{name}", dtype, tuple(words), units, doc, False, bool(said["masked"]))

    @property
    def attributes(self) -> dict[str, str | bool]:
        """What an HDF5 dataset says of itself; a channel says enough for `of_channel`."""
        own: dict[str, str | bool] = {"doc": self.doc, "masked": self.masked} if self.name.startswith(CHANNELS) else {}
        return {"units": self.unit, "dims": self.dims_text, **own}

    @property
    def group(self) -> str:
        """"view", "touches/*" or "truth"."""
        return "touches/*" if self.path.startswith("touches/") else self.path.split("/")[0]

    @property
    def name(self) -> str:
        """The path within its group: the attribute of the record, ``audit/<column>`` or ``channels/<name>``."""
        return self.path.removeprefix(self.group + "/")

    @property
    def dims_text(self) -> str:
        """What ``@dims`` says: the dimensions with a space between; "scalar" for none."""
        return " ".join(self.dims) or "scalar"


def _row(line: str) -> Field:
    """That of a line ``| `path` | dtype | dims | unit | marks | meaning |``."""
    path, dtype, dims, unit, marks, doc = (cell.strip(" `") for cell in line.split("|")[1:-1])
    return Field(path, dtype, tuple(dims.split()) if dims != "scalar" else (), unit, doc, "optional" not in marks,
                 "masked" in marks)


TABLES = Path(__file__).with_name("schema.md").read_text(encoding="utf-8")
FIELDS: list[Field] = [_row(line) for line in TABLES.splitlines() if line.startswith("| `")]
"""The table. A sensor that is not part of this package appends its rows, ``touches/*/channels/NAME``, when it is
imported; a file describes them, so that it is read without that package (`Field.of_channel`)."""

ATTRIBUTES = ("format", "schema_version", "name", "object_index", "view_index", "split", "probe")
"""Attributes of the root of an object file; docs/dataset.md says what they mean."""


def fields_of(group: str) -> tuple[Field, ...]:
    """The rows of one group: "view", "touches/*" or "truth"."""
    return tuple(field for field in FIELDS if field.group == group)


def check_array(field: Field, array: np.ndarray, where: str, lengths: dict[str, int]) -> np.ndarray:
    """``array`` as the schema wants it, or a refusal.

    Args:
        field: the row of the table.
        array: what is to be stored, or was read.
        where: file and path, for the message.
        lengths: length of each letter seen so far in this group; new letters are added.

    Raises:
        DatasetError: wrong number of dimensions, a length that disagrees, or a dtype that would lose information.
    """
    if field.dtype == TEXT:
        array = np.asarray(array, dtype=object).reshape(-1) if np.size(array) == 0 else np.asarray(array, dtype=object)
    else:
        array = np.asarray(array)
        if not np.can_cast(array.dtype, field.dtype, "same_kind"):
            raise DatasetError(f"{where} has dtype {array.dtype}; the schema wants {field.dtype}. Convert it before "
                               f"it is stored.")
        array = array.astype(field.dtype, copy=False)
    check_shape(field, array.shape, where, lengths)
    return array


def check_shape(field: Field, shape: tuple[int, ...], where: str, lengths: dict[str, int]) -> None:
    """Refuse a shape that the schema does not allow, before the array is read; operands as of `check_array`.

    Raises:
        DatasetError: wrong number of dimensions, or a length that disagrees.
    """
    if len(shape) != len(field.dims):
        raise DatasetError(f"{where} has shape {shape}; the schema wants ({', '.join(field.dims)}).")
    for dim, length in zip(field.dims, shape):
        want = int(dim) if dim.isdigit() else lengths.setdefault(dim, length)
        if length != want:
            raise DatasetError(f"{where} has shape {shape}; the schema wants ({', '.join(field.dims)}) with "
                               f"{dim} = {want} here.")


def first_bad(field: Field, array: np.ndarray, converged: np.ndarray | None, *,
              recorded: bool = False) -> tuple[int, ...] | None:
    """Index of the first number that must be finite and is not, or None.

    Args:
        field: the row of the table; ``masked`` rows may be NaN in frames that did not converge.
        array: its values.
        converged: (T,) bool of the touch; None outside touches.
        recorded: whether a real sensor made it, which reads some of the masked fields and leaves others NaN throughout.
    """
    if array.dtype.kind != "f":
        return None
    bad = ~np.isfinite(array)
    if field.masked and converged is not None:
        if recorded and np.isnan(array).all():
            return None
        bad[~np.asarray(converged, bool)] = False
    where = np.argwhere(bad)
    return tuple(int(i) for i in where[0]) if len(where) else None
