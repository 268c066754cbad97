"""Whose a result is: a method's or a ceiling's that ships, or somebody's who claims its name; what it rests on; its
label in a table, and the command that makes it again.

What a row rests on is a fact of the repository: `leaderboard/evidence.json` lists the sha256s of its rows with what
made them. What a result says of itself is never read. A row that ships and is not on the list is an earlier one, of a
method or a scorer that is gone.
"""

from __future__ import annotations

import functools
import hashlib
import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal, Protocol

import msgspec

from vsfsim.bench.board.shipped import shipped_form
from vsfsim.bench.commands.presets import PRESETS, preset
from vsfsim.bench.identity import method_sha256
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.plain_text import plain
from vsfsim.core.shelf import ceilings, folder, methods
from vsfsim.core.table import parse_toml, read_text
from vsfsim.data.disk import write_atomic

PREDICTIONS = "predictions file"
"""What a result of `vsfsim score` has in place of the entry of a method."""
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
    """"open": made once; "sealed": scored against a private part (`vsfsim.bench.sealed`); "verified": made again to the
    same numbers by those who keep the leaderboard, by what follows."""
    command: str
    commit: str
    machine: str
    commitment: _Sha256 | None = None
    """Of the sealed set."""
    receipt: _Sha256 | None = None
    """That its private part scored this row (`vsfsim.bench.sealed.receipt`)."""

    def __post_init__(self) -> None:
        if self.evidence == "sealed" and None in (self.commitment, self.receipt):
            raise ValueError("a sealed row needs the commitment of its set and the receipt of `vsfsim score --sealed`")


def row_sha256(result: Result) -> str:
    """sha256 of all that a row says, its values and scores rounded as they ship."""
    return hashlib.sha256(json.dumps(shipped_form(result), sort_keys=True, default=str).encode()).hexdigest()


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


class Labelled(Protocol):
    """What a label needs of a row."""

    @property
    def result(self) -> Result:
        """Its result."""

    @property
    def mark(self) -> str:
        """Why it is not ranked, or ""."""


def labels_of(rows: Sequence[Labelled]) -> list[str]:
    """The method's name and preset; where it has several rows, with the parameters in which they differ."""
    out = []
    for row in rows:
        result = row.result
        twins = [other.result.parameters for other in rows
                 if (other.result.method, other.result.preset) == (result.method, result.preset)]
        differ = [f"{key}={value}" for key, value in result.parameters.items()
                  if value != "" and any(twin.get(key) != value for twin in twins)]
        words = [*filter(None, ["claimed" if row.mark == CLAIMED else "", result.preset]), *differ]
        out.append(f"{result.method} ({', '.join(words)})" if words else result.method)
    return out


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
