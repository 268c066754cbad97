"""The rows of a leaderboard: how they ship, what they rest on, whose they are, and whether two are one.

A row ships as `leaderboard/TASK/METHOD.json`, a result file without the rows of single touches: what a result says of
itself, its scores, and the value of every metric of each object in each run, in single precision. Who wants the rows of
single touches or the maps of stiffness evaluates the method again. Rows of studies are in `leaderboard/studies/TASK/`.

What a row rests on is a fact of the repository: `leaderboard/evidence.json` lists the sha256s of its rows with what
made them. What a result says of itself is never read, and a row that ships and is not on the list is not ranked.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import shlex
from collections.abc import Collection
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from vsfsim.bench.board.compare import Runs, by_run, paired
from vsfsim.bench.commands.catalogue import PRESETS, preset
from vsfsim.bench.identity import method_sha256
from vsfsim.bench.metrics import METRICS, Answer, Score
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import read_record
from vsfsim.bench.task import Task
from vsfsim.core import table
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.shelf import ceilings, folder, methods
from vsfsim.core.table import parse_toml, read_text


def as_shipped(result: Result) -> Result:
    """What ships of a result: the value of every metric of each object in each run, in single precision, in place of
    the rows of single touches, and scores of nine digits."""
    known = result.values or {metric: {shot: {
        name: [float(np.float32(value)) if math.isfinite(value) else None for value in of.flat]
        for name, of in by_run(result, metric, shot).items()} for shot in result.shots} for metric in METRICS}
    scores = {metric: {shot: Score(float(f"{score.mean:.9g}"), float(f"{score.std:.9g}"), ())
                       for shot, score in by_shot.items()} for metric, by_shot in result.scores.items()}
    return dataclasses.replace(result, queries={}, answers={}, maps={}, data={}, scores=scores, values={
        metric: there for metric, by_shot in known.items() if (there := {k: of for k, of in by_shot.items() if of})})


def row_sha256(result: Result) -> str:
    """sha256 of all that a row says, as it ships."""
    row = as_shipped(result)
    scores = {metric: {shot: [score.mean, score.std] for shot, score in by_shot.items()}
              for metric, by_shot in row.scores.items()}
    return hashlib.sha256(json.dumps({**row.summary(), "scores": scores, "values": row.values}, sort_keys=True,
                                     default=str).encode()).hexdigest()


# ---------------------------------------------------------------------- what rows rest on, and whose they are

PREDICTIONS = "predictions file"
"""What a result of `vsfsim lab score` has in place of the entry of a method."""
LIST = "evidence.json"
"""Name of the list, in the folder of the rows that ship."""
CEILING = "a ceiling, which knows the true object"
"""Why the row of a ceiling is not ranked."""
CLAIMED = "claimed: it has the name of a method that ships, and its source, settings or scores are not that method's"
"""Why a row with a borrowed name is not ranked."""
UNLISTED = "not on the list of the rows that ship"
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
    cpu_s: float = 0.0
    """CPU seconds that it took; 0 where they were not counted."""
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
    found = read_record(path, list[Entry], "list of rows") if path.is_file() else []
    return {entry.sha256: entry for entry in found}


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
    return not result.has(here)


def command_of(result: Result, *, whole: bool = False) -> str:
    """The command that makes a result again, quoted for a shell.

    Args:
        result: the result. whole: every parameter of the method is named, also those of its preset.
    """
    if result.entry == PREDICTIONS:
        return shlex.join(["vsfsim", "lab", "score", "FILE", "--task", result.task, "--name", result.method])
    words = ["vsfsim", "evaluate", "--method", result.method, *(["--preset", result.preset] if result.preset else [])]
    for key, value in result.parameters.items() if whole else ():
        words += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"] * (value is not None)
    return shlex.join([*words, "--task", result.task])


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a release makes of a task, each with CPU minutes, which are estimates."""

    dataset: float
    rows: dict[str, float]
    """By METHOD.PRESET, or the name of a ceiling."""
    audit: float = 0.0
    """0 for none."""
    fresh: dict[str, float] = {}
    """Of one dataset of another seed, ``dataset``, and of rows on it: whether the audit finds the rows over-fit."""
    studies: dict[str, float] = {}
    """By name: of their rows that are no rows of a board."""


def plan() -> dict[str, Part]:
    """What a release makes, by task (`leaderboard/release.toml`).

    Raises:
        TaskError: the table is damaged.
    """
    return _table("release.toml", dict[str, Part])


def absent(task: str, there: Collection[str]) -> dict[str, str]:
    """Why a board lacks rows, by their names, separated by commas: those of the release that are not made, and those
    that no release makes (`leaderboard/absent.toml`).

    Args:
        task: its name. there: the rows that it has, as `Part.rows` names them.

    Raises:
        TaskError: a table is damaged.
    """
    planned = plan()[task].rows if task in plan() else {}
    missing = ", ".join(key for key in planned if key not in there)
    said = {missing: f"not made at this release; `vsfsim lab release --only {task}` makes them"} if missing else {}
    return said | _table("absent.toml", dict[str, dict[str, str]]).get(task, {})


def _table(name: str, kind: Any) -> Any:
    path = folder("leaderboard") / name
    if not path.is_file():
        return {}
    tree = parse_toml(read_text(path, "table", TaskError), path, "table", TaskError)
    return table.value(tree, kind, str(path), TaskError)


_SAME_SCORE = 1e-4
"""Relative difference below which two scores count as one result: a machine with other rounding changes an error by
1e-8 where a touch has a unique equilibrium."""
_OTHER_SCORE = 0.02
"""The same, above which one method on one task cannot have given both."""


def is_same(result: Result, before: Result) -> bool:
    """Whether two results are the same one; the scores of their readings decide, since a pixel that rounding moves
    changes where stiffness is probed."""
    of, other = ({(name, shot): score.mean for name, by_shot in r.scores.items() for shot, score in by_shot.items()
                  if name in METRICS and METRICS[name].answer is Answer.READINGS} for r in (result, before))
    return _of_one_method(result, before) and of.keys() == other.keys() and all(
        math.isclose(mean, other[key], rel_tol=_SAME_SCORE) for key, mean in of.items())


def _of_one_method(one: Result, other: Result) -> bool:
    return all(getattr(one, key) == getattr(other, key) for key in ("method", "preset", "task_sha256", "parameters"))


def contradicts(one: Result, other: Result, mine: Runs, theirs: Runs) -> bool:
    """Whether two results of one method with the same settings on one task have scores that it cannot give both.

    Args:
        one, other: the results. mine, theirs: their areas by object.
    """
    found = paired(mine, theirs)
    return _of_one_method(one, other) and found.told_apart and abs(found.mean) > _OTHER_SCORE * abs(found.level)
