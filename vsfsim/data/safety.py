"""What an HDF5 file may be before a byte of a field is read: files come from strangers.

HDF5 can point into other files, run filters that are loaded from a folder, and announce more data than there are. An
object file of this package does none of that.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import h5py
import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import plain

LARGEST_FIELD = 512 << 20
"""Bytes of one field. A touch of 200 frames with 10,000 vertices has 24 MB."""
LARGEST_CHUNK = 64 << 20
"""Bytes of a chunk, which is unpacked as a whole."""
LARGEST_RATIO, SMALL = 100, 256 << 20
"""A file may hold this many times its own size, besides a small amount [bytes]: numbers do not compress by more."""

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
NAME = r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}"
"""Of an object view or its file, as a regular expression."""


def check_name(name: object, where: str) -> str:
    """``name`` if it can be the name of an object view: letters, digits and ``. _ + -``, no path.

    Raises:
        DatasetError: it cannot; ``where`` begins the message.
    """
    if not isinstance(name, str) or not re.fullmatch(NAME, name):
        raise DatasetError(f"{where}: '{plain(name, longest=100)}' is no name of an object view or its file: letters, "
                           f"digits and . _ + - are allowed, and no path. The dataset is damaged; generate it again.")
    return name


def check_tree(file: h5py.File, path: Path) -> dict[str, h5py.Group | h5py.Dataset]:
    """Refuse links, foreign storage, unknown filters and more data than the file can hold, in every object of it.

    Returns:
        Every object of the file by its path, e.g. "view/depth": to open each of them again would take as long as
        this check.

    Raises:
        DatasetError: with the object and what is wrong.
    """
    total = 0
    budget = SMALL + LARGEST_RATIO * path.stat().st_size
    found: dict[str, h5py.Group | h5py.Dataset] = {}
    waiting: list[tuple[str, h5py.Group]] = [("", file)]
    while waiting:
        where, group = waiting.pop()
        if where.count("/") > 8 or len(group) > 10_000:
            raise DatasetError(f"{path}{where} is nested too deep or has too many members; it was not written by "
                               f"vsfsim.")
        links = group.id.links
        for raw in group.id:  # h5py's low level: a file has thousands of fields, and most of the time went into names
            name = raw.decode("utf-8", "surrogateescape")
            spot = f"{path} {where}/{plain(name, longest=100)}"
            if links.get_info(raw).type != h5py.h5l.TYPE_HARD:
                raise DatasetError(f"{spot} is a link to another place; an object file holds its data itself.")
            opened = h5py.h5o.open(group.id, raw)
            inside = f"{where}/{name}"
            if isinstance(opened, h5py.h5g.GroupID):
                found[inside[1:]] = subgroup = h5py.Group(opened)
                waiting.append((inside, subgroup))
                continue
            if not isinstance(opened, h5py.h5d.DatasetID):
                raise DatasetError(f"{spot} is neither a group nor a dataset.")
            found[inside[1:]] = item = h5py.Dataset(opened)
            total += _size(item, spot)
            if total > budget:
                raise DatasetError(f"{path} announces more than {budget / 1e6:.0f} MB and has "
                                   f"{path.stat().st_size / 1e6:.1f} MB; it was not written by vsfsim.")
    return found


def _size(item: h5py.Dataset, spot: str) -> int:
    # by h5py's low level: its properties ask the file again each time, and a dataset has thousands of fields
    settings = item.id.get_create_plist()
    layout = settings.get_layout()
    if layout == h5py.h5d.VIRTUAL or settings.get_external_count():
        raise DatasetError(f"{spot} keeps its data in another file; an object file holds its data itself.")
    dtype, shape = item.dtype, item.shape
    if dtype.hasobject or dtype.kind not in "fiubS":
        raise DatasetError(f"{spot} has dtype {plain(dtype)}; numbers and padded text are allowed.")
    filters = {settings.get_filter(k)[0] for k in range(settings.get_nfilters())}
    if not filters <= _FILTERS:
        raise DatasetError(f"{spot} is packed with filter {min(filters - _FILTERS)}; gzip and shuffle are allowed.")
    if shape is None:
        raise DatasetError(f"{spot} is empty.")
    size = dtype.itemsize * math.prod(map(int, shape))
    chunk = dtype.itemsize * math.prod(map(int, settings.get_chunk())) if layout == h5py.h5d.CHUNKED else 0
    if size > LARGEST_FIELD or chunk > LARGEST_CHUNK:
        raise DatasetError(f"{spot} has shape {shape}, {size / 1e6:.0f} MB; a field has at most "
                           f"{LARGEST_FIELD / 1e6:.0f} MB, and a chunk {LARGEST_CHUNK / 1e6:.0f} MB.")
    return size


def whole_number(value: object, where: str) -> int:
    """An attribute that must be a whole number >= 0.

    Raises:
        DatasetError: it is not.
    """
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or value < 0:
        raise DatasetError(f"{where} is {plain(value, longest=60)}; it must be a whole number >= 0.")
    return int(value)
