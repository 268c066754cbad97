"""A TOML table of a scene file that knows where it stands and refuses what nobody asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from vsfsim.core.errors import SceneError, did_you_mean, unknown_key


class Table:
    """A table and its place.

    table: the parsed TOML. where: file and section, for the messages. allowed: its keys.

    Raises:
        SceneError: not a table, or an unknown key; every reader below, on a value that is not allowed.
    """

    def __init__(self, table: Any, where: str, allowed: tuple[str, ...]):
        if not isinstance(table, Mapping):
            raise SceneError(f"{where} is {table!r}; it must be a table.")
        for key in table:
            if key not in allowed:
                raise SceneError(unknown_key(where, key, allowed))
        self.table, self.where = table, where

    def number(self, key: str, default: float, low: float, high: float, unit: str = "") -> float:
        """A number from ``low`` to ``high``."""
        value = self.table.get(key, default)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= float(value) <= high:
            raise SceneError(f"{self.where}: {key} is {value!r}; it must be a number from {low:g} to "
                             f"{high:g}{' ' + unit if unit else ''}.")
        return float(value)

    def count(self, key: str, default: int, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        return whole(self.where, key, self.table.get(key, default), low, high)

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
