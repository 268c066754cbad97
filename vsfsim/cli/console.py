"""What commands write besides their results: progress on stderr, JSON for files and pipes."""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any


class Progress:
    """Progress of a command on stderr: one line that changes in a terminal, now and then a line in a log.

    Use it as a context manager and call it with (done, in all, what).

    Args:
        label: name of the command.
        interval: time between two lines in a log [s].
    """

    def __init__(self, label: str, *, interval: float = 20.0):
        self.label, self._live = label, sys.stderr.isatty()
        self._interval = 0.1 if self._live else interval
        self._total = self._first = -1
        self._start, self._written = time.perf_counter(), -math.inf  # the first line comes at once

    def __enter__(self) -> Progress:
        if self._live:
            self._rewrite(f"{self.label}: libraries are loaded")  # of the simulator, which takes seconds
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._rewrite("")

    def __call__(self, done: int, total: int, what: str) -> None:
        now = time.perf_counter()
        if total != self._total:  # Another stage begins: its speed says nothing about the one before.
            self._start, self._first, self._total = now, done, total
        if now - self._written < self._interval:
            return
        self._written, new = now, done - self._first
        left = f", {(now - self._start) / new * (total - done):.0f} s left" if new else ""
        line = f"{self.label}: {done}/{total} {what}{left}"
        if self._live:
            self._rewrite(line)
        else:
            print(line, file=sys.stderr, flush=True)

    def over(self, names: Collection[str], load: Callable[[str], Any]) -> Iterator[Any]:
        """What each name stands for, loaded when it is its turn, which is told."""
        for done, name in enumerate(names):
            self(done, len(names), name)
            yield load(name)

    @staticmethod
    def _rewrite(line: str) -> None:
        """Put a text in the place of the terminal's last line."""
        print(f"\r\x1b[K{line[:shutil.get_terminal_size().columns - 1]}", end="", file=sys.stderr, flush=True)


def step(what: str) -> None:
    """Say on stderr which step of a measurement begins."""
    print(f"  {what} ...", file=sys.stderr, flush=True)


def note(sentence: str) -> None:
    """Say something on stderr that the user should know."""
    print(f"note: {sentence}", file=sys.stderr)


def without_nan(value: Any) -> Any:
    """The same with null for what is no finite number, which JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [without_nan(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def report(words: str, numbers: Any, path: Path | None, *, indent: int | None = None) -> None:
    """Print words, and write the numbers to ``path`` as JSON; only the numbers, to standard output, if that is -.

    Raises:
        DatasetError: the file cannot be written.
    """
    if str(path) != "-":
        print(words)
    write_json(numbers, path, indent=indent)


def write_json(numbers: Any, path: Path | None, *, indent: int | None = None) -> None:
    """Write the numbers to ``path`` as JSON, to standard output if that is -, and nowhere if it is None.

    Raises:
        DatasetError: the file cannot be written.
    """
    text = json.dumps(without_nan(numbers), indent=indent, allow_nan=False)
    if str(path) == "-":
        print(text)
    elif path is not None:
        from vsfsim.data.disk import write_atomic

        write_atomic(path, (text + "\n").encode())
