"""The rows of a leaderboard that ship: one file a task, `leaderboard/TASK.json`, without the rows of single touches.

A row keeps what its result says of itself, its scores, and the value of every metric of each object in single
precision; query readings, which rows share, are there once. Who wants the rows of single touches or the maps of
stiffness evaluates the method again. Rows of studies are in `leaderboard/studies/`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.board.compare import by_object
from vsfsim.bench.metrics import METRICS, Answer, Score, columns_of
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import checked, pack, read_json, unpack
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.data.disk import write_atomic

FORMAT = "vsfsim-leaderboard"
VERSION = 2


def write_rows(rows: Mapping[str, Result], path: Path) -> None:
    """Write the rows of a task, by the names of their result files.

    Raises:
        TaskError: the file cannot be written.
    """
    found = {name: _values(result) for name, result in rows.items()}
    objects = sorted({name for values in found.values() for by_shot in values.values() for of in by_shot.values()
                      for name in of})
    packed = [pack(result.readings) for result in rows.values()]
    readings = [one for k, one in enumerate(packed) if one not in packed[:k]]
    table = {"format": FORMAT, "version": VERSION, "objects": objects, "readings": readings, "rows": {
        name: {**_told(result), "readings": readings.index(of), "values": {
            metric: {shot: [_single(values.get(one)) for one in objects] for shot, values in by_shot.items()}
            for metric, by_shot in found[name].items()}}
        for (name, result), of in zip(rows.items(), packed, strict=True)}}
    write_atomic(path, (json.dumps(table, separators=(",", ":"), allow_nan=False) + "\n").encode(), error=TaskError)


def read_rows(path: Path) -> dict[str, Result]:
    """The rows of a task's file, with `Result.values` in place of the rows of single touches, by the names of the
    result files that they were made from; none where there is no file.

    Raises:
        TaskError: it is damaged.
    """
    if not path.is_file():
        return {}
    table = read_json(path)
    try:
        if table["format"] != FORMAT or table["version"] != VERSION:
            raise ValueError(f"format {plain(table['format'])}, version {plain(table['version'])}")
        objects, readings = [plain(name) for name in table["objects"]], [unpack(part) for part in table["readings"]]
        return {plain(name): _read(row, objects, readings[row["readings"]]) for name, row in table["rows"].items()}
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise TaskError(f"{path} is no leaderboard that ships: {plain(error, longest=300)}. Restore the "
                        f"file.") from error


def row_sha256(result: Result) -> str:
    """sha256 of all that a row says, as it ships: its fields as JSON values, the value of each object in single
    precision, scores of nine digits."""
    values = {metric: {shot: {name: float(np.float32(value)) for name, value in of.items() if math.isfinite(value)}
                       for shot, of in by_shot.items()} for metric, by_shot in _values(result).items()}
    return hashlib.sha256(json.dumps({**_told(result), "values": values}, sort_keys=True,
                                     default=str).encode()).hexdigest()


def _told(result: Result) -> dict[str, Any]:
    """What a result says of itself, and its scores."""
    return {**result.summary(), "scores": {
        metric: {shot: [float(f"{score.mean:.9g}"), float(f"{score.std:.9g}")] for shot, score in by_shot.items()}
        for metric, by_shot in result.scores.items()}}


def _values(result: Result) -> Mapping[str, Mapping[str, Mapping[str, float]]]:
    """Every metric of each object, by metric and shot."""
    if result.values:
        return result.values
    found = {metric: {shot: by_object(result, metric, shot) for shot in result.shots} for metric in METRICS}
    known = {metric: {shot: of for shot, of in by_shot.items() if of} for metric, by_shot in found.items()}
    return {metric: by_shot for metric, by_shot in known.items() if by_shot}


def _read(row: dict[str, Any], objects: Sequence[str], readings: Mapping[str, list]) -> Result:
    values = {metric: {shot: {name: float(np.float32(value)) for name, value in zip(objects, column, strict=True)
                              if value is not None} for shot, column in by_shot.items()}
              for metric, by_shot in row.pop("values").items()}
    scores = {metric: {shot: Score(float(mean), float(std), ()) for shot, (mean, std) in by_shot.items()}
              for metric, by_shot in row["scores"].items()}
    queries: dict[str, list] = {name: [] for name in columns_of(Answer.READINGS)}
    result = checked({**row, "queries": queries, "scores": {}, "readings": readings}, Result)
    return dataclasses.replace(result, scores=scores, values=values)


def _single(value: float | None) -> float | None:
    """In single precision, by the fewest digits that give it."""
    return None if value is None or not math.isfinite(value) else float(str(np.float32(value)))
