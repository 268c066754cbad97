"""What a result file holds: rows, packed into columns, and fields, checked one by one, because strangers write files.

Packed columns are compressed without loss: text as indices, integers and floats in the smallest type that holds them
exactly, all columns in one LZMA stream as base64.
"""

from __future__ import annotations

import base64
import binascii
import json
import lzma
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.metrics import Answer, Record, Score, columns_of
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain

Rows = dict[Answer, list[dict[str, Any]]]

READING_COLUMNS = ("object", "touch", "n", "ss")
"""Of `vsfsim.bench.result.Result.readings`."""


MAP_COLUMNS = ("object", "x", "y", "z", "truth", "mean", "std")
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
        row.update({name: float(np.float32(row[name])) for name in ("sse", "sae", "nll") if name in row})


def beside_zero(rows: Sequence[Record], readings: Mapping[str, Sequence], size: int) -> list[dict[str, Any]]:
    """Rows of `Answer.READINGS` with the sum of squares of the true readings, ``ss``, and the ``size`` d of a reading.

    Args:
        rows: as a result keeps them. readings: `vsfsim.bench.result.Result.readings`, {} if they are not kept.
        size: of a reading.
    """
    known = {(name, touch): ss for name, touch, ss in zip(readings["object"], readings["touch"], readings["ss"],
                                                          strict=True)} if readings else {}
    return [{**row, "ss": known.get((row["object"], row["touch"])), "size": size} for row in rows]


def as_rows(columns: Mapping[str, Sequence]) -> list[dict[str, Any]]:
    """Columns of a result file as rows."""
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


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


SCHEMA_VERSION = 3
PLAIN_VERSION = 2
"""Results of this version hold their rows as lists of numbers; they are read as those of today."""
OLD_VERSION = 1
"""Results of this version hold nothing from which metrics other than those of the readings could be computed again."""

LARGEST_FILE = 64 << 20
"""A result file with more bytes is not read."""
LARGEST_NUMBER = 1e100
"""A larger number in a result is refused: its square is not finite."""


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


def _refuse(word: str) -> float:
    raise ValueError(f"it holds {word}, which is no finite number")


def checked_fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a `Result` from JSON values.

    Raises:
        ValueError, KeyError, TypeError: one of them is malformed; the message says which.
    """
    out = {}
    for name, value in given.items():
        out[name] = _CHECKS[name](name, value)
    counts = {len(column) for column in out["queries"].values()}
    if len(counts) != 1:
        raise ValueError("the columns of queries have different lengths")
    for name in ("readings", "maps"):
        if len({len(column) for column in out.get(name, {}).values()}) > 1:
            raise ValueError(f"the columns of {name} have different lengths")
    for metric, by_shot in out["scores"].items():
        for shot, score in by_shot.items():
            if shot not in out["shots"] or len(score.per_seed) != len(out["seeds"]) or not math.isclose(
                    score.mean, Score.of(list(score.per_seed)).mean, rel_tol=1e-9, abs_tol=1e-12):
                raise ValueError(f"{metric} at shot {shot} does not fit its {len(out['seeds'])} seeds")
    return out


def _word(where: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be text")
    return plain(value)


def _number(where: str, value: Any, *, low: float = -LARGEST_NUMBER) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= LARGEST_NUMBER:
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be a finite number"
                         + (f" of at least {low:g}" if low > -LARGEST_NUMBER else ""))
    return float(value)


def _count(where: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 53:
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be a whole number >= 0")
    return value


def _table(where: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be a table")
    return value


def _list(where: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be a list")
    return value


def _plain_table(where: str, value: Any) -> dict[str, Any]:
    """A table of what is only shown: numbers, text, and lists of them."""
    return {plain(key): _shown(f"{where}.{plain(key)}", item, 3) for key, item in _table(where, value).items()}


def _shown(where: str, value: Any, depth: int) -> Any:
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, (int, float)):
        return value if isinstance(value, int) and abs(value) < 1 << 63 else _number(where, value)
    if isinstance(value, str):
        return plain(value)
    if depth and isinstance(value, list):
        return [_shown(where, item, depth - 1) for item in value]
    if depth and isinstance(value, dict):
        return {plain(key): _shown(where, item, depth - 1) for key, item in value.items()}
    raise ValueError(f"{where} is nested too deep")


def _words(where: str, value: Any) -> tuple[str, ...]:
    return tuple(_word(where, item) for item in _list(where, value))


def _seeds(where: str, value: Any) -> tuple[int, ...]:
    out = tuple(_count(where, item) for item in _list(where, value))
    if not out or len(set(out)) != len(out):
        raise ValueError(f"{where} is {plain(value, longest=60)}; it must be different whole numbers, at least one")
    return out


def _timing(where: str, value: Any) -> dict[str, float]:
    return {plain(key): _number(f"{where}.{plain(key)}", item, low=0.0) for key, item in _table(where, value).items()}


def _scores(where: str, value: Any) -> dict[str, dict[str, Score]]:
    out: dict[str, dict[str, Score]] = {}
    for metric, by_shot in _table(where, value).items():
        for shot, score in _table(f"{where}.{plain(metric)}", by_shot).items():
            spot = f"{where}.{plain(metric)}.{plain(shot)}"
            table = _table(spot, score)
            if set(table) != {"mean", "std", "per_seed"}:
                raise ValueError(f"{spot} has {plain(', '.join(sorted(table)))}; it must have mean, std and per_seed")
            per_seed = tuple(_number(f"{spot}.per_seed", v) for v in _list(spot, table["per_seed"]))
            if not per_seed:
                raise ValueError(f"{spot} has no seed")
            out.setdefault(plain(metric), {})[plain(shot)] = Score(
                _number(f"{spot}.mean", table["mean"]), _number(f"{spot}.std", table["std"], low=0.0), per_seed)
    return out


_COLUMNS: dict[str, Callable[[str, Any], Any]] = {
    "object": _word, "shot": _word, "seed": _count, "touch": _count, "n": _count, "in50": _count, "in90": _count,
    "sse": lambda where, value: _number(where, value, low=0.0),
    "sae": lambda where, value: _number(where, value, low=0.0),
    "ss": lambda where, value: _number(where, value, low=0.0), "nll": _number,
    "x": _count, "y": _count, "z": _count, "truth": lambda where, value: _number(where, value, low=0.0),
    "mean": lambda where, value: _number(where, value, low=0.0),
    "std": lambda where, value: _number(where, value, low=0.0),
}


def _columns(where: str, value: Any, names: tuple[str, ...]) -> dict[str, list]:
    table = _table(where, value)
    if is_packed(table):
        try:
            table = unpack(table)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{where} is no packed table: {plain(error, longest=60)}") from error
    if set(table) != set(names):
        odd = plain(", ".join(sorted(set(table) ^ set(names))))
        raise ValueError(f"{where}: missing or unknown column {odd}")
    out: dict[str, list] = {}
    for name in names:
        check = _COLUMNS.get(name)
        spot = f"{where}.{name}"
        if check is _word:  # few words, each in many rows
            given = _list(spot, table[name])
            words = {item: _word(spot, item) for item in {item for item in given if isinstance(item, str)}}
            out[name] = [words[item] if isinstance(item, str) else _word(spot, item) for item in given]
            continue
        out[name] = _plain_numbers(_list(spot, table[name]), check) or [
            (None if item is None else _number(spot, item)) if check is None else check(spot, item)
            for item in table[name]]
    return out


def _plain_numbers(column: list[Any], check: Callable[[str, Any], Any] | None) -> list[Any]:
    """The column itself where none of its numbers needs a look of its own, since all are whole, or all finite and not
    negative; else []."""
    kinds = set(map(type, column))
    if check is _count:
        return column if kinds == {int} and min(column) >= 0 and max(column) < 1 << 53 else []
    if kinds == {float} and all(map(math.isfinite, column)) and min(column) >= 0.0 and max(column) <= LARGEST_NUMBER:
        return column
    return []


def _queries(where: str, value: Any) -> dict[str, list]:
    out = _columns(where, value, columns_of(Answer.READINGS))
    if any(n < 1 for n in out["n"]):
        raise ValueError(f"{where}.n holds a 0; a query touch has at least one reading")
    return out


def _readings(where: str, value: Any) -> dict[str, list]:
    return _columns(where, value, READING_COLUMNS) if _table(where, value) else {}


def _answers(where: str, value: Any) -> dict[str, dict[str, list]]:
    out = {}
    for name, columns in _table(where, value).items():
        if name not in {answer.value for answer in Answer} - {Answer.READINGS.value}:
            raise ValueError(f"{where} has '{plain(name, longest=60)}', which no method is asked")
        # a result of a version that has other metrics keeps those that both have
        if is_packed(columns):
            columns = unpack(columns)
        known = [c for c in columns_of(Answer(name)) if c in _table(f"{where}.{name}", columns)]
        out[name] = _columns(f"{where}.{name}", {c: columns[c] for c in known}, tuple(known))
        if len({len(column) for column in out[name].values()}) != 1:
            raise ValueError(f"the columns of {where}.{name} have different lengths")
    return out


def _maps(where: str, value: Any) -> dict[str, list]:
    return _columns(where, value, MAP_COLUMNS) if _table(where, value) else {}


_CHECKS: dict[str, Callable[[str, Any], Any]] = {
    **dict.fromkeys(("task", "task_sha256", "dataset_sha256", "method", "entry", "observation", "unit", "isolation",
                     "preset", "evidence"),
                    _word),
    **dict.fromkeys(("dataset_made_by", "parameters", "machine", "made_by", "versions", "package", "study", "contents"),
                    _plain_table),
    "shots": _words, "seeds": _seeds, "scores": _scores, "queries": _queries, "timing": _timing,
    "peak_memory_mib": lambda where, value: _number(where, value, low=0.0), "notes": _words, "readings": _readings,
    "data": _table, "answers": _answers, "maps": _maps, "schema_version": _count,
}
