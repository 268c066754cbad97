"""The reader of TOML files, scenes and tasks: the fields of a dataclass are the keys of its table, and their types say
what is allowed::

    @dataclass(frozen=True)
    class Arm:
        tool: Literal["flange", "punyo"] = "flange"
        yaw: Annotated[float, between(-6.3, 6.3, "rad")] = 0.0

    typed({"yaw": 1.0}, Arm, "scene.toml [arm]")

Any value of a scene may be a distribution, ``{ uniform = [a, b] }``, ``{ loguniform = [a, b] }``,
``{ choice = [..] }`` or ``{ each = [..] }``. Of ``each``, object number k of a dataset takes entry k, and the list
begins again after its end.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
import numpy as np

from vsfsim.core.errors import SceneError, VsfsimError, did_you_mean
from vsfsim.core.plain_text import plain

LARGEST_FILE = 4 << 20
"""A TOML file with more bytes is not read."""
T = TypeVar("T")
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


def shipped_rows(module: str, file: str, kind: Any) -> dict[str, Any]:
    """The tables of a TOML ``file`` that ships, by their names, each of class ``kind``.

    Args:
        module: the ``__file__`` of the module whose folder ``file`` is relative to.
    """
    return msgspec.toml.decode(Path(module).parent.joinpath(file).read_bytes(), type=dict[str, kind])


def between(low: float, high: float, unit: str = "", *, whole: bool = False) -> msgspec.Meta:
    """Of a field: a number from ``low`` to ``high``."""
    return msgspec.Meta(ge=low, le=high, description=f"a {'whole ' * whole}number from {low:{'' if whole else 'g'}} "
                                                     f"to {high:{'' if whole else 'g'}}{' ' * bool(unit)}{unit}")


Count = Annotated[int, msgspec.Meta(ge=0)]
Positive = Annotated[int, msgspec.Meta(ge=1)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Finite = Annotated[float, msgspec.Meta(ge=-1e300, le=1e300, description="a finite number")]
Vector = Annotated[tuple[Finite, Finite, Finite], msgspec.Meta(description="3 numbers")]
Angle = Annotated[float, between(-2 * math.pi, 2 * math.pi, "rad")]
Rows = Annotated[list[Any], msgspec.Meta(description="a list of tables, each under its own [[...]]")]
Friction = Annotated[float, between(0.0, 10.0)]

_WORDS = {"int": "a whole number", "float": "a number", "str": "text", "bool": "true or false", "array": "a list",
          "object": "a table", "null": "nothing"}


def typed(table: Any, kind: type[T], where: str, *, also: tuple[str, ...] = (),
          error: type[VsfsimError] = SceneError, **given: Any) -> T:
    """A table as a record of a dataclass, whose fields are the keys; a key that is not there leaves its default.

    Args:
        table: the parsed TOML. kind: the class; its types say what is allowed (`between`, `msgspec.Meta`), and its
        ``__post_init__`` may raise ValueError. where: file and section, for the messages. also: keys that are allowed
        and read elsewhere. error: the class of the errors. given: values of fields that are no keys, or of keys in
        ``also``.

    Raises:
        VsfsimError: of class ``error``; it is no table, a key is unknown or missing, or a value is not allowed.
    """
    fields = {f.name: f for f in dataclasses.fields(kind) if f.name not in given}  # type: ignore[arg-type]
    check_keys(table, where, (*fields, *also), error)
    hints = _hints(kind)  # type: ignore[arg-type]
    values = {}
    for key, one in fields.items():
        if key in table:
            values[key] = value(table[key], hints[key], f"{where}: {key}", error)
        elif one.default is one.default_factory is dataclasses.MISSING:
            raise error(f"{where}: '{key}' is missing.")
    try:
        return kind(**values, **given)
    except ValueError as problem:  # what the class itself says
        raise error(f"{where}: {problem}.") from problem


def check_keys(table: Any, where: str, allowed: Collection[str],
               error: type[VsfsimError] = SceneError) -> Mapping[str, Any]:
    """``table`` if it is one and has only ``allowed`` keys.

    Raises:
        VsfsimError: of class ``error``; it is none, or has another key.
    """
    if not isinstance(table, Mapping):
        raise error(f"{where} is {table!r}; it must be a table.")
    for key in table:
        if key not in allowed:
            raise error(f"{where}: unknown key '{key}'. {did_you_mean(key, allowed)}")
    return table


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def value(given: Any, hint: Any, place: str, error: type[VsfsimError] = SceneError) -> Any:
    """One value of a table as a type; ``place`` begins the message.

    Raises:
        VsfsimError: of class ``error``; it is not of the type.
    """
    try:
        return msgspec.convert(given, hint)
    except msgspec.ValidationError as problem:
        members = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
        bare = [getattr(one, "__origin__", one) if hasattr(one, "__metadata__") else one for one in members]
        for key, item, kind in (found for one in bare for found in _items(given, one)):
            value(item, kind, f"{place}{key}", error)
        for one in filter(dataclasses.is_dataclass, bare):
            typed(given, one, place, error=error)  # type: ignore[arg-type]
        words = [word for one in bare if get_origin(one) is Literal for word in get_args(one)]
        if words and given not in words and isinstance(given, str):
            raise error(f"{place} is {given!r}. {did_you_mean(given, words)}") from problem
        said = re.sub(r"`([\w| ]+)`", lambda found: " or ".join(
            _WORDS.get(word, word) for word in found[1].split(" | ")), str(problem).removeprefix("Expected "))
        rules = [meta.description for one in members for meta in getattr(one, "__metadata__", ()) if meta.description]
        rule = rules[0] if rules else said.partition(", got")[0].partition(" - at `$")[0]
        raise error(f"{place} is {'missing' if given is None else repr(given)}; it must be {rule}.") from problem


def _items(given: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """The items of a list or a table, each with its place and the type that ``kind`` asks of it."""
    asked, origin = get_args(kind), get_origin(kind)
    if isinstance(given, (list, tuple)) and origin in (list, tuple):
        for k, item in enumerate(given):
            yield f"[{k}]", item, asked[k] if k < len(asked) and asked[k] is not ... else asked[0]
    elif isinstance(given, Mapping) and origin in (dict, Mapping):
        for key, item in given.items():
            yield f".{key}", item, asked[1]


_DISTRIBUTIONS = ("uniform", "loguniform", "choice", "each")


def sample(tree: Any, rng: np.random.Generator, *, number: int = 0) -> Any:
    """The tree with every distribution drawn, in the order of the file; a choice may hold distributions itself.

    Args:
        tree: the parsed scene.
        rng: random stream.
        number: of the object in its dataset, from 0.
    """
    if _is_distribution(tree):
        ((kind, args),) = tree.items()
        if kind == "uniform":
            return float(rng.uniform(*args))
        if kind == "loguniform":
            return math.exp(rng.uniform(math.log(args[0]), math.log(args[1])))
        return sample(args[number % len(args) if kind == "each" else int(rng.integers(len(args)))], rng, number=number)
    if isinstance(tree, Mapping):
        return {key: sample(value, rng, number=number) for key, value in tree.items()}
    return [sample(value, rng, number=number) for value in tree] if isinstance(tree, list) else tree


def _is_distribution(node: Any) -> bool:
    return isinstance(node, Mapping) and len(node) == 1 and next(iter(node)) in _DISTRIBUTIONS


def ends(node: Any, where: str) -> list:
    """Trees without distributions in which every end of every distribution, nested ones too, occurs at least once.

    Raises:
        SceneError: a distribution without numbers, or with its ends in the wrong order; ``where`` begins the message.
    """
    if _is_distribution(node):
        ((kind, args),) = node.items()
        _check_distribution(kind, args, f"{where}: distribution {{ {kind} = {args!r} }}:")
        return [end for value in args for end in ends(value, where)]
    if not isinstance(node, (Mapping, list)):
        return [node]
    named = node.items() if isinstance(node, Mapping) else enumerate(node)
    inner = {key: ends(value, f"{where}: {key}") for key, value in named}
    rows = [{key: some[i % len(some)] for key, some in inner.items()}
            for i in range(max((len(some) for some in inner.values()), default=1))]
    return rows if isinstance(node, Mapping) else [list(row.values()) for row in rows]


def _check_distribution(kind: str, args: Any, where: str) -> None:
    if not isinstance(args, list) or not args:
        raise SceneError(f"{where} give a list, e.g. {{ uniform = [0.1, 0.2] }}.")
    if kind in ("choice", "each"):
        return
    try:
        low, high = msgspec.convert(args, tuple[Finite, Finite])
    except msgspec.ValidationError as error:
        raise SceneError(f"{where} give two finite numbers [low, high].") from error
    if low > high or (kind == "loguniform" and low <= 0):
        raise SceneError(f"{where} it must satisfy {'0 < ' * (kind == 'loguniform')}low <= high.")
