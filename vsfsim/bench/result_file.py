"""What a result file holds: rows, packed into columns, and fields. Types are checked, because strangers write files.

Packed columns are compressed without loss: lists in MessagePack, in one LZMA stream as base64.
"""

from __future__ import annotations

import base64
import binascii
import dataclasses
import json
import lzma
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from vsfsim.bench.metrics import Answer, Record, Score, columns_of
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import write_atomic

Rows = dict[Answer, list[dict[str, Any]]]

READING_COLUMNS = ("object", "touch", "n", "ss")
"""Of `vsfsim.bench.result.Result.readings`."""


MAP_COLUMNS = ("object", "x", "y", "z", "truth", "mean")
"""Of `vsfsim.bench.result.Result.maps`."""

MAP_STEP, MAP_ORIGIN = 1e-4, 30_000
"""A coordinate of a map is a whole number: of steps [m] from -3 m."""


def as_columns(answer: Answer, rows: Sequence[Record]) -> dict[str, list]:
    """Rows as the columns of a result file."""
    return {name: [_plain(row.get(name)) for row in rows] for name in columns_of(answer)}


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def stored(rows: Sequence[dict[str, Any]]) -> None:
    """Round the sums of errors to single precision (6e-8), as the results of tasks with cross-validation store them,
    so that scores are those of the stored rows."""
    for row in rows:
        row["sse"] = float(np.float32(row["sse"]))


def beside_zero(rows: Sequence[Record], readings: Mapping[str, Sequence]) -> list[dict[str, Any]]:
    """Rows of `Answer.READINGS` with the sum of squares of the true readings, ``ss``.

    Args:
        rows: as a result keeps them. readings: `vsfsim.bench.result.Result.readings`, {} if they are not kept.
    """
    known = {(name, touch): ss for name, touch, ss in zip(readings["object"], readings["touch"], readings["ss"],
                                                          strict=True)} if readings else {}
    return [{**row, "ss": known.get((row["object"], row["touch"]))} for row in rows]


def as_rows(columns: Mapping[str, Sequence]) -> list[dict[str, Any]]:
    """Columns of a result file as rows."""
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


FORMAT = "lzma msgpack"
LARGEST_TABLE = 64 << 20
"""A table with more bytes is refused."""
SCHEMA_VERSION = 4
LARGEST_FILE = 64 << 20
"""A result file with more bytes is not read."""
LARGEST_NUMBER = 1e100
"""A larger number in a result is refused: its square is not finite."""

Count = Annotated[int, msgspec.Meta(ge=0, lt=1 << 53)]
Number = Annotated[float, msgspec.Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
Size = Annotated[float, msgspec.Meta(ge=0.0, le=LARGEST_NUMBER)]
Columns = dict[str, list[str | float | int | None]]
Values = dict[str, dict[str, dict[str, Number | list[Number | None]]]]
"""Of `vsfsim.bench.result.Result.values`."""
_COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("object", "shot"), list[str]), **dict.fromkeys(("sse", "ss", "truth", "mean"), list[Size]),
    **dict.fromkeys(("seed", "touch", "x", "y", "z"), list[Count]),
    "n": list[Annotated[int, msgspec.Meta(ge=1, lt=1 << 53)]]}
"""Types of columns; a metric's column is of numbers and None."""


def pack(columns: Mapping[str, Sequence[Any]]) -> dict[str, Any]:
    """Columns of equal length as a JSON value, {} of none; `unpack` takes it back.

    Args:
        columns: by name, each of texts, of whole numbers >= 0, or of floats and None.
    """
    if not columns:
        return {}
    content = msgspec.msgpack.encode(columns, enc_hook=lambda number: number.item())  # of NumPy
    return {"packed": FORMAT, "size": len(content), "data": base64.b64encode(lzma.compress(content)).decode()}


class _Packed(msgspec.Struct):
    packed: Annotated[str, msgspec.Meta(pattern=f"^{FORMAT}$")]
    size: Annotated[int, msgspec.Meta(ge=0, le=LARGEST_TABLE)]
    data: str


def unpack(value: Mapping[str, Any], kind: Any = Columns) -> Any:
    """What is in a JSON value of `pack`, of a kind; a table that is not packed as it is.

    Raises:
        ValueError: it is malformed, or announces more than it holds.
    """
    if "packed" not in value:
        return dict(value)
    table = msgspec.convert(value, _Packed)
    try:
        stream = lzma.LZMADecompressor(format=lzma.FORMAT_XZ, memlimit=1 << 28)
        content = stream.decompress(base64.b64decode(table.data, validate=True), max_length=table.size + 1)
    except (lzma.LZMAError, binascii.Error, ValueError) as error:
        raise ValueError(f"a packed table cannot be decompressed: {error}") from error
    if len(content) != table.size:
        raise ValueError(f"a packed table does not hold the {table.size} bytes that it announces")
    return _cleaned(msgspec.msgpack.decode(content, type=kind))


def read_json(path: Path) -> Any:
    """The JSON in a result file.

    Raises:
        TaskError: it is missing, too large, no JSON, nested too deep, or holds a number that is not finite.
    """
    try:
        size = path.stat().st_size
        if size > LARGEST_FILE:
            raise ValueError(f"it has {size / 1e6:.0f} MB, and a result has at most {LARGEST_FILE / 1e6:.0f}")
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except (OSError, ValueError, RecursionError) as error:
        raise TaskError(f"result {path} cannot be read: {plain(error, longest=300)}. Evaluate the method "
                        f"again.") from error


def read_record(path: Path, kind: Any, what: str) -> Any:
    """The record of a type ``kind`` in a JSON file of this repository's; ``what`` says in messages what it should be.

    Raises:
        TaskError: it is missing, or is none.
    """
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, ValueError, RecursionError) as error:
        raise TaskError(f"{path} is no {what}: {plain(error)}. Restore the file.") from error


def write_record(path: Path, record: Any) -> None:
    """Write what `read_record` reads.

    Raises:
        TaskError: the file cannot be written.
    """
    write_atomic(path, msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n", error=TaskError)


def _refuse(word: str) -> float:
    raise ValueError(f"it holds {word}, which is no finite number")


def checked(given: Mapping[str, Any], kind: type) -> Any:
    """A `vsfsim.bench.result.Result`, ``kind``, from JSON values.

    Raises:
        ValueError, KeyError, TypeError, AttributeError, RecursionError: one is malformed; the message says which.
    """
    tables: dict[str, Any] = {key: columns(given.get(key) or {}, names) for key, names in (
        ("readings", READING_COLUMNS), ("maps", MAP_COLUMNS))}
    tables["queries"] = columns(given["queries"], columns_of(Answer.READINGS))
    kept = given.get("answers") or {}
    tables["answers"] = {answer.value: columns(kept[answer.value], columns_of(answer), some=True)
                         for answer in Answer if answer.value in kept}
    tables["values"] = msgspec.convert(unpack(given.get("values") or {}, Values), Values)
    told = {key: value for key, value in given.items() if key not in (*tables, "data")}
    out: Any = msgspec.convert({**_cleaned(told), "queries": {}}, kind)
    for metric, by_shot in out.scores.items() if not tables["values"] else ():
        for shot, score in by_shot.items():
            if shot not in out.shots or len(score.per_seed) != len(out.seeds) or not math.isclose(
                    score.mean, Score.of(list(score.per_seed)).mean, rel_tol=1e-9, abs_tol=1e-12):
                raise ValueError(f"{metric} at shot {shot} does not fit its {len(out.seeds)} seeds")
    if not out.seeds or len(set(out.seeds)) != len(out.seeds):
        raise ValueError("seeds must be different whole numbers, at least one")
    return dataclasses.replace(out, **tables, data=dict(given.get("data") or {}))


def columns(value: Any, names: tuple[str, ...], *, some: bool = False) -> dict[str, list]:
    """Some columns of a table, packed or of lists; {} of an empty one. With ``some`` those that are there: a result of
    a version that has other metrics keeps those that both have.

    Raises:
        ValueError, KeyError, TypeError: one is missing, of another length than the others, or of another kind.
    """
    table = unpack(value)
    out = {name: msgspec.convert(table[name], _COLUMNS.get(name, list[Number | None]))
           for name in names if table and (name in table or not some)}
    if len({len(column) for column in out.values()}) > 1:
        raise ValueError(f"the columns {', '.join(names)} have different lengths")
    return out


def _cleaned(value: Any) -> Any:
    if isinstance(value, str):
        return plain(value)
    if isinstance(value, dict):
        return {plain(key): _cleaned(item) for key, item in value.items()}
    return [_cleaned(item) for item in value] if isinstance(value, list) else value
