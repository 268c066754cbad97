"""The reader of TOML files: scenes and tasks. A table knows its place in the file, for the messages.

What a key may hold can stand beside the field of the dataclass that it becomes::

    @dataclass(frozen=True)
    class Arm:
        tool: str = word("flange", "punyo")
        yaw: float = number(0.0, -6.3, 6.3, "rad")

    read(Arm, {"yaw": 1.0}, "scene.toml [arm]")
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from vsfsim.core.errors import SceneError, VsfsimError, did_you_mean, unknown_key
from vsfsim.core.plain_text import plain

LARGEST_FILE = 4 << 20
"""A TOML file with more bytes is not read."""


DEEPEST = 50
"""Levels of tables and lists that a TOML file may have."""


def read_text(path: Path, kind: str, error: type[VsfsimError]) -> str:
    """The text of a TOML file; ``kind`` is "scene" or "task".

    Raises:
        VsfsimError: of class ``error``; it cannot be read.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise OSError(f"it has more than {LARGEST_FILE} bytes")
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as problem:
        raise error(f"{kind} file '{path}' cannot be read: {problem}. Give the path of a TOML text file.") from problem


def parse_toml(text: str, path: Path, kind: str, error: type[VsfsimError]) -> dict[str, Any]:
    """The tree of a TOML text; ``path`` names it in messages.

    Raises:
        VsfsimError: of class ``error``; it is not valid TOML.
    """
    try:
        tree = tomllib.loads(text)
        if _deeper(tree, DEEPEST):
            raise ValueError(f"its tables are more than {DEEPEST} deep")
        return tree
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as problem:
        raise error(f"{kind} file '{path}' is not valid TOML: {plain(problem)}.") from problem


def _deeper(tree: Any, levels: int) -> bool:
    """Whether tables and lists are nested more than ``levels`` deep."""
    row = [tree]
    for _ in range(levels + 1):
        row = [value for node in row if isinstance(node, (dict, list))
               for value in (node.values() if isinstance(node, dict) else node)]
    return bool(row)


class Table:
    """A table and its place.

    A reader without a default needs its key.

    Args:
        table: the parsed TOML.
        where: file and section, for the messages.
        allowed: its keys.

    Raises:
        SceneError: not a table, or an unknown key; every reader below, on a value that is missing or not allowed.
    """

    def __init__(self, table: Any, where: str, allowed: tuple[str, ...]):
        if not isinstance(table, Mapping):
            raise SceneError(f"{where} is {table!r}; it must be a table.")
        for key in table:
            if key not in allowed:
                raise SceneError(unknown_key(where, key, allowed))
        self.table, self.where = table, where

    def flag(self, key: str, default: bool | None = None) -> bool:
        """True or false."""
        value = self._value(key, default)
        if not isinstance(value, bool):
            raise SceneError(f"{self.where}: {key} is {value!r}; it must be true or false.")
        return value

    def number(self, key: str, default: float | None, low: float, high: float, unit: str = "") -> float:
        """A number from ``low`` to ``high``."""
        value = self._value(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= float(value) <= high:
            raise SceneError(f"{self.where}: {key} is {value!r}; it must be a number from {low:g} to "
                             f"{high:g}{' ' + unit if unit else ''}.")
        return float(value)

    def count(self, key: str, default: int | None, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        return whole(self.where, key, self._value(key, default), low, high)

    def vector(self, key: str, default: tuple[float, ...] | None, size: int = 3) -> Any:
        """``size`` finite numbers, a tuple of that length."""
        return numbers(self.where, key, self.table.get(key, default), size)

    def word(self, key: str, default: str, allowed: tuple[str, ...]) -> str:
        """One of ``allowed``."""
        value = self.table.get(key, default)
        if value not in allowed:
            raise SceneError(f"{self.where}: {key} is {value!r}. {did_you_mean(str(value), allowed)}")
        return value

    def rows(self, key: str) -> list[Any]:
        """A list, or none; e.g. of the tables that ``[[key]]`` gives."""
        value = self.table.get(key, [])
        if not isinstance(value, list):
            raise SceneError(f"{self.where}: {key} is {value!r}; it must be a list of tables: write "
                             f"[[{key}]] for each.")
        return value

    def _value(self, key: str, default: Any) -> Any:
        if default is None and key not in self.table:
            raise SceneError(f"{self.where}: '{key}' is missing.")
        return self.table.get(key, default)


def whole(where: str, key: str, value: Any, low: int, high: int) -> int:
    """``value`` if it is a whole number from ``low`` to ``high``."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise SceneError(f"{where}: {key} is {value!r}; it must be a whole number from {low} to {high}.")
    return value


def numbers(where: str, key: str, value: Any, size: int) -> Any:
    """``value`` as a tuple of floats if it is ``size`` finite numbers."""
    if not isinstance(value, (list, tuple)) or len(value) != size or any(
        isinstance(v, bool) or not isinstance(v, (int, float)) or not math.isfinite(v) for v in value
    ):
        raise SceneError(f"{where}: {key} is {value!r}; it must be {size} numbers.")
    return tuple(float(v) for v in value)


def number(default: float | None, low: float, high: float, unit: str = "") -> Any:
    """The field of a number from ``low`` to ``high``."""
    return dataclasses.field(default=default, metadata={"get": lambda t, key: t.number(key, None, low, high, unit)})


def integer(default: int, low: int, high: int) -> Any:
    """The field of a whole number from ``low`` to ``high``."""
    return dataclasses.field(default=default, metadata={"get": lambda t, key: t.count(key, None, low, high)})


def flag(default: bool) -> Any:
    """The field of true or false."""
    return dataclasses.field(default=default, metadata={"get": lambda t, key: t.flag(key)})


def word(default: str, *others: str) -> Any:
    """The field of one of some words."""
    return dataclasses.field(default=default, metadata={"get": lambda t, key: t.word(key, default, (default, *others))})


def vector(default: tuple[float, ...], size: int = 3) -> Any:
    """The field of ``size`` numbers."""
    return dataclasses.field(default=default, metadata={"get": lambda t, key: t.vector(key, None, size)})


Row = TypeVar("Row")


def read(cls: type[Row], node: Any, where: str, more: tuple[str, ...] = (), **given: Any) -> Row:
    """The dataclass that a table describes; a key that is not there leaves the field's default.

    Args:
        cls: its fields made by `number`, `integer`, `flag`, `word` and `vector` are keys of the table.
        node: the parsed TOML.
        where: file and section, for the messages.
        more: further keys that the table may have, which are read elsewhere.
        given: other fields.

    Raises:
        SceneError: not a table, an unknown key, or a value that is not allowed.
    """
    known = {f.name: f.metadata["get"] for f in dataclasses.fields(cls) if f.metadata}  # type: ignore[arg-type]
    t = Table(node, where, (*known, *more))
    return cls(**{key: get(t, key) for key, get in known.items() if key in t.table}, **given)
