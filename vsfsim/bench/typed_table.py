"""Tables of TOML files as records: a message says the place, what was given and what is allowed."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import msgspec

from vsfsim.core.errors import TaskError, did_you_mean, unknown_key

T = TypeVar("T")
Count = Annotated[int, msgspec.Meta(ge=0)]
Positive = Annotated[int, msgspec.Meta(ge=1)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]

_WORDS = {"int": "a whole number", "float": "a number", "str": "text", "bool": "true or false", "array": "a list",
          "object": "a table", "null": "nothing"}


def typed(table: Any, kind: type[T], where: str, *, also: tuple[str, ...] = ()) -> T:
    """A table as a record of a dataclass, whose fields are the keys.

    Args:
        table: the parsed TOML. kind: the class; ``Annotated`` fields say what is allowed (`msgspec.Meta`), and its
        ``__post_init__`` may raise ValueError. where: file and section, for the messages. also: keys that are allowed
        and are no fields.

    Raises:
        TaskError: it is no table; a key is unknown or missing; a value is not allowed.
    """
    if not isinstance(table, Mapping):
        raise TaskError(f"{where} is {table!r}; it must be a table.")
    names = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for key in table:
        if key not in (*names, *also):
            raise TaskError(unknown_key(where, key, (*names, *also)))
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        said, _, place = str(error).partition(" - at `$")
        missing = re.match(r"Object missing required field `(\w+)`", said)
        if missing:
            inner = re.sub(r"\[(\d+)\]", lambda k: f" {int(k[1]) + 1}", place.strip(".`")).replace(".", " ")
            raise TaskError(f"{' '.join([where, inner]).strip()}: '{missing[1]}' is missing.") from error
        said = re.sub(r"`([\w| ]+)`", lambda found: " or ".join(
            _WORDS.get(word, word) for word in found[1].split(" | ")), said).removeprefix("Expected ")
        key = re.match(r"\.(\w+)", place)
        if key is None:  # what the class itself says
            raise TaskError(f"{where}: {said}.") from error
        if said.startswith("Invalid enum value"):
            one_of(str(table[key[1]]), get_args(get_type_hints(kind)[key[1]]), f"{where}: {key[1]}")
        raise TaskError(f"{where}: {key[1]} is {table[key[1]]!r}; it must be {said}.") from error


def one_of(value: str, allowed: Any, what: str) -> str:
    """``value`` if it is one of ``allowed``; ``what`` begins the message.

    Raises:
        TaskError: it is not.
    """
    if value not in allowed:
        raise TaskError(f"{what} is '{value}'. {did_you_mean(value, allowed)}")
    return value
