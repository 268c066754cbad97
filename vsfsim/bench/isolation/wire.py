"""What the scorer and a method's process say to one another.

The scorer sends pickles: the process trusts the scorer. The process answers with JSON, float64 numbers and bytes that
only another process of the same method reads, because reading a pickle runs code, and the code of a method must not
run in the scorer.
"""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

_LENGTH = struct.Struct("<I")
_LARGEST_HEAD = 16 << 20
"""Bytes of the JSON of an answer."""


class Garbled(Exception):
    """The other side answered with something that is no answer."""


@dataclass(frozen=True)
class Reply:
    """An answer of the process."""

    head: dict[str, Any]
    """JSON values."""
    arrays: tuple[np.ndarray, ...]
    """float64."""
    blob: bytes
    """Bytes that only another process of the same method reads."""


@dataclass(frozen=True)
class Description:
    """What a method says of itself before it is built."""

    entry: str
    """Its module:attribute."""
    parameters: Mapping[str, Any]
    """Of the constructor, all of them."""
    seeded: bool
    """Its constructor takes a ``seed``."""
    package: str
    """The installed package that it is from, "" for a file that is not installed."""
    version: str
    """Of that package."""


@dataclass(frozen=True)
class Learned:
    """What a method learned in one training."""

    state: bytes
    """Read by processes of the same method only."""
    on_host: bool
    """Its trials need no GPU."""
    opened: tuple[str, ...]
    """Files that its process opened."""
    seconds: float
    """That `meta_fit` took."""
    seed: int | None
    """That it was built with."""
    environment: Mapping[str, str]
    """Variables that it was given."""


def receive_request(line: Connection) -> tuple[str, Any]:
    """In the process: the name of what is asked and its operands, their arrays read-only.

    Raises:
        EOFError, OSError: the scorer has ended.
    """
    operation, payload = pickle.loads(line.recv_bytes())
    freeze(payload)
    return operation, payload


def send_reply(line: Connection, head: dict[str, Any], arrays: Sequence[np.ndarray] = (), blob: bytes = b"") -> None:
    """In the process: answer a request.

    Raises:
        OSError: the scorer has ended.
    """
    text = json.dumps({**head, "shapes": [list(array.shape) for array in arrays]}).encode()
    contents = [np.ascontiguousarray(array, "<f8").tobytes() for array in arrays]
    line.send_bytes(b"".join((_LENGTH.pack(len(text)), text, *contents, blob)))


def receive_reply(line: Connection, *, most: int) -> Reply:
    """In the scorer: the answer to a request.

    Args:
        most: bytes that its arrays and its blob may have. More is not read.

    Raises:
        EOFError: the process has ended.
        Garbled: this is no answer.
    """
    try:
        content = line.recv_bytes(most + _LARGEST_HEAD)
    except ConnectionError as error:
        raise EOFError from error
    except OSError as error:
        raise Garbled(f"it announces more than the {most} bytes that fit the question") from error
    try:
        end = _LENGTH.size + _LENGTH.unpack_from(content)[0]
        head = json.loads(content[_LENGTH.size:end])
        shapes = [tuple(map(int, shape)) for shape in head.pop("shapes")]
        if not isinstance(head, dict) or any(n < 0 for shape in shapes for n in shape):
            raise ValueError("a shape is negative")
        if len(content) - end > most or any(len(shape) > 4 for shape in shapes):
            raise ValueError(f"{len(content) - end} bytes, over the {most} that fit the question")
        arrays = []
        for shape in shapes:
            count = int(np.prod(shape, dtype=object))
            arrays.append(np.frombuffer(content, "<f8", count, end).reshape(shape))
            end += 8 * count
        return Reply(head, tuple(arrays), content[end:])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError, struct.error) as error:
        raise Garbled(f"{type(error).__name__}: {error}") from error


def freeze(item: Any) -> None:
    """Make every array in a tree of dataclasses, lists, tuples and dictionaries read-only."""
    if isinstance(item, np.ndarray):
        item.flags.writeable = False
    elif is_dataclass(item):
        for field in fields(item):
            freeze(getattr(item, field.name))
    elif isinstance(item, (list, tuple)):
        for part in item:
            freeze(part)
    elif isinstance(item, dict):
        for part in item.values():
            freeze(part)
