"""What the scorer and a method's process say to one another.

The scorer sends pickles: the process trusts the scorer. The process answers with JSON and float64 numbers only, because
reading a pickle runs code, and the code of a method must not run in the scorer.
"""

from __future__ import annotations

import json
import os
import pickle
import struct
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

_LENGTH = struct.Struct("<Q")
_LARGEST_HEAD = 16 << 20
"""Bytes of the JSON of an answer."""


class Closed(Exception):
    """The other side has ended."""


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


class Channel:
    """One end of a connection.

    Args:
        receive, send: file descriptors.
    """

    def __init__(self, receive: int, send: int):
        self.receive, self.send = receive, send

    def close(self) -> None:
        """Let go of both descriptors."""
        for handle in {self.receive, self.send}:
            os.close(handle)

    def send_request(self, operation: str, payload: Any) -> None:
        """From the scorer: the name of what is asked and its operands.

        Raises:
            Closed: the process has ended.
        """
        content = pickle.dumps((operation, payload), protocol=5)
        self._write(_LENGTH.pack(len(content)), content)

    def receive_request(self) -> tuple[str, Any]:
        """In the process: the next request, its arrays read-only.

        Raises:
            Closed: the scorer has ended.
        """
        operation, payload = pickle.loads(self._read(_LENGTH.unpack(self._read(_LENGTH.size))[0]))
        freeze(payload)
        return operation, payload

    def send_reply(self, head: dict[str, Any], arrays: Sequence[np.ndarray] = (), blob: bytes = b"") -> None:
        """In the process: answer a request.

        Raises:
            Closed: the scorer has ended.
        """
        shapes = [list(array.shape) for array in arrays]
        text = json.dumps({**head, "shapes": shapes, "blob": len(blob)}).encode()
        contents = [np.ascontiguousarray(array, "<f8").tobytes() for array in arrays]
        self._write(_LENGTH.pack(len(text)), text, *contents, blob)

    def receive_reply(self, *, most: int) -> Reply:
        """In the scorer: the answer to a request.

        Args:
            most: bytes that its arrays and its blob may have. More is not read.

        Raises:
            Closed: the process has ended.
            Garbled: this is no answer.
        """
        size = _LENGTH.unpack(self._read(_LENGTH.size))[0]
        if size > _LARGEST_HEAD:
            raise Garbled(f"its head has {size} bytes")
        try:
            head = json.loads(self._read(size))
            shapes = [tuple(int(n) for n in shape) for shape in head.pop("shapes")]
            blob = int(head.pop("blob"))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            raise Garbled(f"its head cannot be read ({type(error).__name__})") from error
        if not isinstance(head, dict) or blob < 0 or any(n < 0 for shape in shapes for n in shape):
            raise Garbled("its head is malformed")
        total = blob
        for shape in shapes:
            count = 8
            for n in shape:
                count *= n
            total += count
        if total > most or len(shapes) > 100_000 or any(len(shape) > 4 for shape in shapes):
            raise Garbled(f"it announces {len(shapes)} arrays of {total} bytes, over the {most} that fit the question")
        arrays = tuple(np.frombuffer(self._read(8 * int(np.prod(shape, dtype=int))), "<f8").reshape(shape)
                       for shape in shapes)
        return Reply(head, arrays, self._read(blob))

    def _read(self, size: int) -> bytes:
        parts, left = [], size
        while left:
            try:
                part = os.read(self.receive, min(left, 1 << 20))
            except OSError as error:
                raise Closed from error
            if not part:
                raise Closed
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _write(self, *contents: bytes) -> None:
        for content in contents:
            view = memoryview(content)
            while view:
                try:
                    view = view[os.write(self.send, view):]
                except OSError as error:
                    raise Closed from error


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
