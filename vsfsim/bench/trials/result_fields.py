"""The fields of a result file, checked one by one: files come from strangers."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vsfsim.bench.metrics import Answer, columns_of
from vsfsim.bench.trials.packed import is_packed, unpack
from vsfsim.bench.trials.rows import MAP_COLUMNS, READING_COLUMNS, Score
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain

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
