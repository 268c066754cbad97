"""What the scorer and a method's process say to one another.

The scorer sends pickles: the process trusts the scorer. The process answers with values of MessagePack, float64 arrays
and bytes that only another process of the same method reads, because reading a pickle runs code, and the code of a
method must not run in the scorer.
"""

from __future__ import annotations

import pickle
from multiprocessing.connection import Connection
from typing import Any

import msgspec
import numpy as np

from vsfsim.bench.method import Method
from vsfsim.core.errors import MethodError

_LARGEST_HEAD = 16 << 20
"""Bytes of an answer besides its arrays and its bytes."""


class Garbled(Exception):
    """The other side answered with something that is no answer."""


class Reply(msgspec.Struct):
    """An answer of the process."""

    head: dict[str, Any] = {}
    """Plain values."""
    arrays: tuple[np.ndarray, ...] = ()
    """float64."""
    blob: bytes = b""
    """Bytes that only another process of the same method reads."""


def receive_reply(line: Connection, *, most: int) -> Reply:
    """In the scorer: the answer to a request.

    Args:
        most: bytes that its arrays and its blob may have. More is not read.

    Raises:
        EOFError: the process has ended.
        Garbled: this is no answer.
    """
    try:
        return decoded(line.recv_bytes(most + _LARGEST_HEAD), Reply)
    except ConnectionError as error:
        raise EOFError from error
    except OSError as error:
        raise Garbled(f"it announces more than the {most} bytes that fit the question") from error
    except ValueError as error:
        raise Garbled(str(error)) from error


def encoded(value: Any) -> bytes:
    """A record with float64 arrays as bytes."""
    return msgspec.msgpack.encode(value, enc_hook=_bytes_of)


def decoded(content: bytes, kind: Any) -> Any:
    """The record of the type ``kind`` in what `encoded` made, its arrays read-only.

    Raises:
        ValueError: there is none.
    """
    try:
        return msgspec.msgpack.decode(content, type=kind, dec_hook=_array_of)
    except (ValueError, TypeError, OverflowError, RecursionError, MemoryError) as error:
        raise ValueError(f"{type(error).__name__}: {error}") from error


def packed(method: Method) -> bytes:
    """What a method has learned: the pickled method.

    Raises:
        MethodError: it cannot be pickled.
    """
    try:
        return pickle.dumps(method)
    except Exception as error:  # of what a method holds, anything may refuse to be pickled
        raise MethodError(f"what the method learned cannot be handed to its trials: it cannot be pickled ({error}). "
                          f"Give it __getstate__() and __setstate__().") from error


def _bytes_of(array: Any) -> tuple[tuple[int, ...], bytes]:
    array = np.asarray(array, "<f8")
    return array.shape, array.tobytes()


def _array_of(_: type, given: tuple[list[int], bytes]) -> np.ndarray:
    return np.frombuffer(given[1], "<f8").reshape(given[0])
