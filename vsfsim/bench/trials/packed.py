"""Columns of a result file, compressed without loss: text as indices, integers and floats in the smallest type that
holds them exactly, all columns in one LZMA stream as base64."""

from __future__ import annotations

import base64
import binascii
import lzma
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

FORMAT = "lzma"
MOST_ROWS = 20_000_000
"""A table with more rows is refused."""

_TYPES = {"u1": 1, "u2": 2, "u4": 4, "u8": 8, "f4": 4, "f8": 8}
_INTEGERS = ("u1", "u2", "u4", "u8")


def pack(columns: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Columns of equal length as a JSON value; `unpack` takes it back.

    Args:
        columns: by name, each of texts, of whole numbers >= 0, or of floats and None.
    """
    kinds, contents, rows = {}, [], 0
    for name, values in columns.items():
        rows = len(values)
        kind, array = _column(list(values))
        kinds[name] = kind
        contents.append(array.tobytes())
    content = b"".join(contents)
    # with no larger dictionary than the content, whose 64 MiB would take 40 ms to lay out
    filters = [{"id": lzma.FILTER_LZMA2, "preset": 9, "dict_size": min(max(len(content), 4096), 64 << 20)}]
    data = lzma.compress(content, format=lzma.FORMAT_XZ, filters=filters)
    return {"packed": FORMAT, "rows": rows, "columns": kinds, "data": base64.b64encode(data).decode()}


def is_packed(value: Any) -> bool:
    """Whether a JSON value is what `pack` returns."""
    return isinstance(value, dict) and "packed" in value


def unpack(value: Mapping[str, Any]) -> dict[str, list]:
    """The columns in a JSON value of `pack`.

    Raises:
        ValueError: it is malformed, or announces more than it holds.
    """
    if value["packed"] != FORMAT or not isinstance(value.get("columns"), dict):
        raise ValueError("a packed table has an unknown format")
    rows = value["rows"]
    if isinstance(rows, bool) or not isinstance(rows, int) or not 0 <= rows <= MOST_ROWS:
        raise ValueError("a packed table has no valid number of rows")
    sizes = [rows * _TYPES[kind["type"]] for kind in value["columns"].values()]
    try:
        stream = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=1 << 28)
        content = stream.decompress(base64.b64decode(value["data"], validate=True), max_length=sum(sizes) + 1)
    except (lzma.LZMAError, binascii.Error, TypeError, ValueError) as error:
        raise ValueError(f"a packed table cannot be decompressed: {error}") from error
    if len(content) != sum(sizes):
        raise ValueError(f"a packed table holds {len(content)} bytes, not {sum(sizes)}")
    out, at = {}, 0
    for (name, kind), size in zip(value["columns"].items(), sizes, strict=True):
        array = np.frombuffer(content[at:at + size], f"<{kind['type']}")
        at += size
        out[name] = _values(array, kind.get("words"))
    return out


def _column(values: list[Any]) -> tuple[dict[str, Any], np.ndarray]:
    if values and all(isinstance(v, str) for v in values):
        words = list(dict.fromkeys(values))
        number = {word: k for k, word in enumerate(words)}
        array = _smallest(np.array([number[v] for v in values], np.uint64))
        return {"type": array.dtype.str[1:], "words": words}, array
    if all(isinstance(v, int) and not isinstance(v, bool) and v >= 0 for v in values):
        array = _smallest(np.array(values, np.uint64))
        return {"type": array.dtype.str[1:]}, array
    array = np.array([np.nan if v is None else v for v in values], np.float64)
    with np.errstate(over="ignore"):
        single = array.astype(np.float32)
    if np.array_equal(single.astype(np.float64), array, equal_nan=True):
        array = single
    return {"type": array.dtype.str[1:]}, array.astype(array.dtype.newbyteorder("<"))


def _smallest(array: np.ndarray) -> np.ndarray:
    most = int(array.max(initial=0))
    kind = next(k for k in _INTEGERS if most < 1 << (8 * _TYPES[k]))
    return array.astype(f"<{kind}")


def _values(array: np.ndarray, words: Any) -> list:
    if words is not None:
        if array.dtype.kind != "u" or not isinstance(words, list) or (len(array) and int(array.max()) >= len(words)):
            raise ValueError("a packed column of words has an index without a word")
        return [words[k] for k in array.tolist()]
    if array.dtype.kind == "u":
        return array.tolist()
    return [None if v != v else v for v in array.astype(np.float64).tolist()]
