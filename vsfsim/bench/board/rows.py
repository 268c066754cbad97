"""The rows of a leaderboard: how they ship, what they rest on, whose they are, and whether two are one.

The rows of a task ship as one file, `leaderboard/TASK.json`, without the rows of single touches: what a result says of
itself, its scores, and the value of every metric of each object in single precision; query readings, which rows share,
are there once. Who wants the rows of single touches or the maps of stiffness evaluates the method again. Rows of
studies are in `leaderboard/studies/`.

What a row rests on is a fact of the repository: `leaderboard/evidence.json` lists the sha256s of its rows with what
made them. What a result says of itself is never read. A row that ships and is not on the list is an earlier one, of a
method or a scorer that is gone.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from vsfsim.bench.board.compare import ByObject, by_object, paired
from vsfsim.bench.commands.catalogue import PRESETS, preset
from vsfsim.bench.identity import method_sha256
from vsfsim.bench.metrics import METRICS, Answer, Score, columns_of, metrics_of
from vsfsim.bench.result import Result, readings_apart
from vsfsim.bench.result_file import checked, pack, read_json, unpack
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.plain_text import plain
from vsfsim.core.shelf import ceilings, folder, methods
from vsfsim.core.table import parse_toml, read_text
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


# ---------------------------------------------------------------------- what rows rest on, and whose they are

PREDICTIONS = "predictions file"
"""What a result of `vsfsim lab score` has in place of the entry of a method."""
LIST = "evidence.json"
"""Name of the list, in the folder of the rows that ship."""
CEILING = "a ceiling, which knows the true object"
"""Why the row of a ceiling is not ranked."""
CLAIMED = "claimed: it has the name of a method that ships, and its source, settings or scores are not that method's"
"""Why a row with a borrowed name is not ranked."""
EARLIER = "an earlier row, of a method or a scorer that is gone"
"""Why a row that ships and is not on the list is not ranked."""

_Sha256 = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


class Entry(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """What the repository knows of a row that ships."""

    sha256: _Sha256
    """Of the row (`row_sha256`)."""
    task: str
    method: str
    evidence: Literal["open", "sealed", "verified"]
    """"open": made once; "sealed": scored against a private part (`vsfsim.bench.predictions`); "verified": made again
    to the same numbers by those who keep the leaderboard, by what follows."""
    command: str
    commit: str
    machine: str
    other_bits: bool = False
    """Its dataset is the task's, made on a machine that rounds otherwise."""
    commitment: _Sha256 | None = None
    """Of the sealed set."""
    receipt: _Sha256 | None = None
    """That its private part scored this row (`vsfsim.bench.predictions.receipt`)."""

    def __post_init__(self) -> None:
        if self.evidence == "sealed" and None in (self.commitment, self.receipt):
            raise ValueError("a sealed row needs the commitment of its set and the receipt of `lab score --sealed`")


def listed() -> dict[str, Entry]:
    """The list, by the sha256 of a row; {} where there is none.

    Raises:
        TaskError: the file is damaged, or a sealed row has no receipt.
    """
    path = folder("leaderboard") / LIST
    if not path.is_file():
        return {}
    try:
        return {entry.sha256: entry for entry in msgspec.json.decode(path.read_bytes(), type=list[Entry])}
    except (OSError, msgspec.MsgspecError) as error:
        raise TaskError(f"{path} is no list of rows: {plain(error)}. Restore the file.") from error


def write_list(entries: Iterable[Entry], path: Path) -> None:
    """Write the list, an entry a line.

    Raises:
        TaskError: the file cannot be written.
    """
    order = sorted(entries, key=lambda e: (e.task, e.method, e.sha256))
    lines = ",\n".join(msgspec.json.encode(entry).decode() for entry in order)
    write_atomic(path, f"[\n{lines}\n]\n".encode(), error=TaskError)


def is_ceiling(result: Result) -> bool:
    """Whether a result is of a ceiling (`vsfsim.bench.commands.ceiling`)."""
    entry = ceilings().get(result.method)
    return entry is not None and entry.value == result.entry


_source = functools.cache(method_sha256)


def claimed(result: Result, task: Task) -> bool:
    """Whether a result has the name of a method or a ceiling that ships, and is of another one: of another entry,
    package or source, of a file of predictions, or of other settings than those of its preset."""
    entry = (methods() | ceilings()).get(result.method)
    if entry is None or (entry.dist is not None and entry.dist.name != "vsfsim"):
        return False
    if (result.entry, result.contents.get("the method")) != (entry.value, _source(result.method)) or result.package.get(
            "name", "vsfsim") not in ("vsfsim", ""):
        return True
    if result.preset not in PRESETS:
        return False
    try:
        here = preset(result.method, result.preset, task.observation.name, task.metric.answer.value).parameters
    except MethodError:  # there is no such preset
        return True
    return any(result.parameters.get(key) != value for key, value in here.items() if key != "device")


def command_of(result: Result, *, whole: bool = False) -> str:
    """The command that makes a result again, quoted for a shell.

    Args:
        result: the result. whole: every parameter of the method is named, also those of its preset.
    """
    if result.entry == PREDICTIONS:
        return shlex.join(["vsfsim", "score", "FILE", "--task", result.task, "--name", result.method])
    words = ["vsfsim", "evaluate", "--method", result.method, *(["--preset", result.preset] if result.preset else [])]
    for key, value in result.parameters.items() if whole else ():
        words += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"] * (value is not None)
    return shlex.join([*words, "--task", result.task])


def absent(task: str) -> dict[str, str]:
    """Why a leaderboard lacks rows, of `leaderboard/absent.toml`, by the names of their methods, separated by commas;
    {} where nothing is said.

    Args:
        task: name of the task.

    Raises:
        TaskError: the file is damaged.
    """
    path = folder("leaderboard") / "absent.toml"
    if not path.is_file():
        return {}
    said = parse_toml(read_text(path, "leaderboard", TaskError), path, "leaderboard", TaskError).get(task, {})
    if not isinstance(said, dict):
        raise TaskError(f"{path}: '{task}' is {said!r}; give a table of names of methods and reasons, as "
                        f"[{task}] and below it fem-map = \"why\".")
    return said


SAME_READINGS = 1e-3
"""Datasets whose readings differ by less, by `result.readings_apart`, count as the same dataset made on a machine with
other rounding: an error changes by about that fraction of the readings at most. Rounding alone gives 1e-8 where a touch
has a unique equilibrium; other seeds, scenes or physics differ by tens of per cent."""
_ROUNDING = 1e-8  # of the nine digits of a score that ships
_SAME_SCORE = 1e-4
"""Relative difference below which two scores on such datasets count as one result."""
_OTHER_SCORE = 0.02
"""The same, above which one method on one task cannot have given both."""


def is_same(result: Result, before: Result) -> bool:
    """Whether two results are the same one. One of them may be from a machine with other rounding; the scores
    decide."""
    names, tolerance = list(result.scores), _ROUNDING
    if result.dataset_sha256 != before.dataset_sha256:
        apart = readings_apart(result.readings, before.readings)
        if apart is None or not apart < SAME_READINGS or result.scores.keys() != before.scores.keys():
            return False
        names = [metric.name for metric in metrics_of(Answer.READINGS) if metric.name in result.scores]
        tolerance = _SAME_SCORE
    if not _of_one_method(result, before) or any(
            result.scores[name].keys() != before.scores.get(name, {}).keys() for name in names):
        return False
    pairs = [(result.scores[name][shot], before.scores[name][shot]) for name in names for shot in result.scores[name]]
    return all(math.isclose(a, b, rel_tol=tolerance) for one, other in pairs  # a row that ships has means alone
               for a, b in zip((one.mean, *one.per_seed), (other.mean, *other.per_seed), strict=False))


def _of_one_method(one: Result, other: Result) -> bool:
    return all(getattr(one, key) == getattr(other, key) for key in ("method", "preset", "task_sha256", "parameters"))


def contradicts(one: Result, other: Result, task: Task, objects: tuple[ByObject, ByObject]) -> bool:
    """Whether two results of one method with the same settings on one task have scores that it cannot give both.

    Args:
        one, other: the results. task: of both. objects: the values of both by object, {} where the task has none.
    """
    mine, theirs = (r.scores[task.primary][task.ranking_shot].mean for r in (one, other))
    return _of_one_method(one, other) and not math.isclose(mine, theirs, rel_tol=_OTHER_SCORE) and (
        not task.protocol.folds or paired(*objects).told_apart)
