"""The rows of a leaderboard that ship: one file a task, `leaderboard/TASK.json`, without the rows of single touches.

A row keeps what its result says of itself, its scores, the value of every metric of each object, and its map of
stiffness; query readings and probed points, which rows share, are there once. Values have single precision, stiffness
0.1 %. Who wants the rows of single touches evaluates the method again. Rows of studies are in `leaderboard/studies/`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.board.compare import by_object
from vsfsim.bench.metrics import METRICS, Answer, Score, columns_of
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import MAP_COLUMNS, checked, pack, read_json, unpack
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import write_atomic

FORMAT = "vsfsim-leaderboard"
VERSION = 1
_RAW = ("queries", "answers", "data", "readings", "maps", "scores", "values")
_PLACES = tuple(name for name in MAP_COLUMNS if name not in ("mean", "std"))
_DECADE, _LEAST = 1000.0, 12.0
"""A stiffness is stored as its decades over 1e-12, a thousand steps each; 0 where it is not positive."""


@dataclass(frozen=True)
class Shipped:
    """A row that ships."""

    name: str
    """Of the result file that it was made from."""
    result: Result
    """Its result, with `Result.values` in place of the rows of single touches."""
    mark: str
    """Why it is not ranked, or ""."""
    other_bits: bool
    """Its dataset is the board's, made on a machine that rounds otherwise."""


def write_rows(rows: Sequence[Shipped], path: Path) -> None:
    """Write the rows of a task.

    Raises:
        TaskError: the file cannot be written.
    """
    rows = [dataclasses.replace(row, result=dataclasses.replace(row.result, values=_values(row.result)))
            for row in rows]
    objects = sorted({name for row in rows for by_shot in row.result.values.values() for values in by_shot.values()
                      for name in values})
    shared: list[dict[str, Any]] = []
    table = {"format": FORMAT, "version": VERSION, "objects": objects, "rows": [
        _packed(row, objects, shared) for row in rows], "shared": shared}
    write_atomic(path, (json.dumps(table, separators=(",", ":"), allow_nan=False) + "\n").encode(), error=TaskError)


def read_rows(path: Path) -> list[Shipped]:
    """The rows of a task's file; none where there is no file.

    Raises:
        TaskError: it is damaged.
    """
    if not path.is_file():
        return []
    table = read_json(path)
    try:
        if table["format"] != FORMAT or table["version"] != VERSION:
            raise ValueError(f"format {plain(table['format'])}, version {plain(table['version'])}")
        objects, shared = [plain(name) for name in table["objects"]], [unpack(part) for part in table["shared"]]
        return [_unpacked(row, objects, shared) for row in table["rows"]]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise TaskError(f"{path} is no leaderboard that ships: {plain(error, longest=300)}. Restore the "
                        f"file.") from error


def row_sha256(result: Result) -> str:
    """sha256 of all that a row says, as it ships: its fields as JSON values, the value of each object in single
    precision, scores of nine digits."""
    values = {metric: {shot: {name: _single(value) for name, value in of.items() if math.isfinite(value)}
                       for shot, of in by_shot.items()} for metric, by_shot in _values(result).items()}
    told = {key: value for key, value in result.summary().items() if key not in _RAW}
    form = {**told, "values": values, "scores": _scores(result)}
    return hashlib.sha256(json.dumps(form, sort_keys=True, default=str).encode()).hexdigest()


def _scores(result: Result) -> dict[str, dict[str, list[float]]]:
    return {metric: {shot: [_short(score.mean), _short(score.std)] for shot, score in by_shot.items()}
            for metric, by_shot in result.scores.items()}


def _values(result: Result) -> Mapping[str, Mapping[str, Mapping[str, float]]]:
    """Every metric of each object, by metric and shot."""
    if result.values:
        return result.values
    found = {metric: {shot: by_object(result, metric, shot) for shot in result.shots} for metric in METRICS}
    known = {metric: {shot: of for shot, of in by_shot.items() if of} for metric, by_shot in found.items()}
    return {metric: by_shot for metric, by_shot in known.items() if by_shot}


def _packed(row: Shipped, objects: Sequence[str], shared: list[dict[str, Any]]) -> dict[str, Any]:
    values = {f"{metric} {shot}": [_single(of.get(name)) for name in objects]
              for metric, by_shot in row.result.values.items() for shot, of in by_shot.items()}
    maps, result = row.result.maps, row.result
    may_lack = {f.name for f in dataclasses.fields(Result)
                if f.default is not dataclasses.MISSING or f.default_factory is not dataclasses.MISSING}
    told = {key: value for key, value in result.summary().items()
            if key not in _RAW and (key not in may_lack or value not in ({}, (), ""))}
    out = {"name": row.name, "mark": row.mark, "other_bits": row.other_bits, **told, "values": pack(values),
           "scores": _scores(result)}
    if result.readings:
        out["readings"] = _place(pack(result.readings), shared)
    if maps:
        out["points"] = _place(pack({name: maps[name] for name in _PLACES}), shared)
        mean = np.array([np.nan if value is None else value for value in maps["mean"]])
        known = mean > 0.0
        code = np.zeros(len(mean), int)
        code[known] = np.clip(np.rint(_DECADE * (np.log10(mean[known]) + _LEAST)), 1, 65535)
        out["stiffness"] = pack({"code": code.tolist()})
    return out


def _place(part: dict[str, Any], shared: list[dict[str, Any]]) -> int:
    if part not in shared:
        shared.append(part)
    return shared.index(part)


def _unpacked(row: dict[str, Any], objects: Sequence[str], shared: Sequence[Mapping[str, list]]) -> Shipped:
    own = ("name", "mark", "other_bits", "values", "scores", "readings", "points", "stiffness")
    given = {key: value for key, value in row.items() if key not in own}
    given |= {"queries": {name: [] for name in columns_of(Answer.READINGS)}, "scores": {},
              "readings": shared[row["readings"]] if "readings" in row else {}}
    if "points" in row:
        code = np.array(unpack(row["stiffness"])["code"], float)
        mean = np.where(code > 0.0, 10.0 ** (code / _DECADE - _LEAST), 0.0)
        given["maps"] = {**shared[row["points"]], "mean": mean.tolist(), "std": [0.0] * len(mean)}
    result = checked(given, Result)
    values: dict[str, dict[str, dict[str, float]]] = {}
    for key, column in unpack(row["values"]).items():
        metric, _, shot = key.partition(" ")
        values.setdefault(metric, {})[shot] = {name: value for name, value in zip(objects, column, strict=True)
                                               if value is not None}
    scores = {metric: {shot: Score(float(mean), float(std), ()) for shot, (mean, std) in by_shot.items()}
              for metric, by_shot in row["scores"].items()}
    return Shipped(plain(row["name"]), dataclasses.replace(result, scores=scores, values=values), plain(row["mark"]),
                   bool(row["other_bits"]))


def _single(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(np.float32(value))


def _short(value: float) -> float:
    return float(f"{value:.9g}")
