"""Whose a result is: a method's, of this version or an earlier one, a ceiling's, or somebody's who only claims the
name; its label in a table, and the command that makes it again."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from vsfsim.bench.commands.presets import PRESETS, preset
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import ceilings, methods

PREDICTIONS = "predictions file"
"""What a result of `vsfsim score` has in place of the entry of a method."""


def is_ceiling(result: Result) -> bool:
    """Whether a result is of a ceiling (`vsfsim.bench.commands.ceiling`)."""
    entry = ceilings().get(result.method)
    return entry is not None and entry.value == result.entry


def claimed(result: Result) -> bool:
    """Whether a result has the name of a method that ships, and is of another one or of a file of predictions."""
    entry = methods().get(result.method)
    if entry is None or entry.dist is None or entry.dist.name != "vsfsim":
        return False
    return result.entry != entry.value or result.package.get("name", "vsfsim") not in ("vsfsim", "")


def is_earlier(result: Result, task: Task, source: Callable[[str], str]) -> bool:
    """Whether a method that is installed has another source, or its preset other settings, than a result was made
    with; also of a result that does not say its source.

    Args:
        result: the result. task: of the board. source: of a method's name, its `vsfsim.bench.method.method_sha256`.
    """
    if result.method not in methods() or claimed(result):
        return False
    if result.contents.get("the method") != source(result.method):
        return True
    if result.preset not in PRESETS:
        return False
    try:
        here = preset(result.method, result.preset, task.observation.name, task.metric.answer.value).parameters
    except MethodError:  # no such preset any more
        return True
    return any(result.parameters.get(key) != value for key, value in here.items() if key != "device")


def labels_of(results: list[Result]) -> list[str]:
    """The method's name and preset; where it has several rows, with the parameters in which they differ."""
    out = []
    for result in results:
        twins = [other.parameters for other in results
                 if (other.method, other.preset) == (result.method, result.preset)]
        differ = [f"{key}={value}" for key, value in result.parameters.items()
                  if value != "" and any(twin.get(key) != value for twin in twins)]
        words = [*filter(None, ["claimed" if claimed(result) else "", result.preset]), *differ]
        out.append(f"{result.method} ({', '.join(words)})" if words else result.method)
    return out


def command_of(result: Result, *, whole: bool = False) -> str:
    """The command that makes a result again.

    Args:
        result: the result. whole: every parameter of the method is named, also those of its preset.
    """
    if result.entry == PREDICTIONS:
        return f"vsfsim score FILE --task {result.task} --name {result.method}"
    given = "" if not result.preset else f" --preset {result.preset}"
    every = "".join(f" --set {key}={_toml(value)}" for key, value in result.parameters.items() if value is not None
                    ) if whole else ""
    return f"vsfsim evaluate --method {result.method}{given}{every} --task {result.task}"


def _toml(value: Any) -> str:
    """A value of `--set`, quoted for a shell where it needs that."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if text.replace(".", "").replace("-", "").replace("_", "").isalnum() else "'" + text.replace(
        "'", "'\\''") + "'"
