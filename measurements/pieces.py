"""Touches of single objects under single settings, made by many processes and kept in a file as they come."""

from __future__ import annotations

import contextlib
import functools
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from measurements.measurement import Progress
from measurements.stability.team import kept
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.system.content import file_sha256
from vsfsim.generate.trade.made import Run, Touched
from vsfsim.generate.trade.runs import touched
from vsfsim.generate.trade.setting import Setting
from vsfsim.generate.workers import process_pool, submit


@dataclass(frozen=True)
class Piece:
    """All touches of one object under a setting, or one of them on a mesh of its own."""

    scene: str
    """Path of the scene's file."""
    number: int
    """Of the object."""
    touches: int
    """Of the object."""
    setting: Setting
    """Under which they are made."""
    alone: int | None = None
    """Number of the touch that is made on a mesh of its own; None for all on one."""

    @property
    def key(self) -> str:
        """Its name in the file."""
        own = "" if self.alone is None else f", touch {self.alone}"
        return f"object {self.number}, {self.touches} touches, {self.setting.key}{own}"


@functools.lru_cache(maxsize=8)
def object_of(scene: str, sha256: str, number: int, touches: int) -> Touched:
    """The touches of one object of a scene, whose file has this sha256.

    Raises:
        VsfsimError: they cannot be made again.
    """
    return touched(load_scene(Path(scene)), touches=touches, objects=1, first=number, seed=0, device="cpu", cache=None)


def made(piece: Piece) -> dict[str, Any]:
    """The run of a piece as `Run.table` has it, or why it cannot be made."""
    try:
        subject = object_of(piece.scene, file_sha256(Path(piece.scene)), piece.number, piece.touches)
        if piece.alone is None:
            return subject.run(piece.setting).table()
        return subject.near(piece.alone, piece.setting).table()
    except VsfsimError as error:
        return {"refused": str(error)}


class Pieces:
    """Runs by the key of their piece.

    Args:
        file: where they are kept; what an earlier run has there is not made again.
        circumstances: that must be those of the file.
        workers: processes.
        until: of `time.perf_counter`; begin nothing new after it [s].
        progress: called with what is done.

    Raises:
        VsfsimError: see `kept`.
    """

    def __init__(self, file: Path, circumstances: Mapping[str, Any], *, workers: int, until: float,
                 progress: Progress):
        self.file, self.workers, self.until, self.progress = file, workers, until, progress
        file.parent.mkdir(parents=True, exist_ok=True)
        rows = kept(file, circumstances, "vsfsim measure promise")
        self.rows: dict[str, dict[str, Any]] = {row["key"]: row["run"] for row in rows}

    def __enter__(self) -> Pieces:
        self._stack = contextlib.ExitStack()
        self._pool = self._stack.enter_context(process_pool(self.workers, self.workers))
        return self

    def __exit__(self, *error: Any) -> None:
        self._stack.close()

    def ask(self, pieces: Iterable[Piece]) -> list[Run | str | None]:
        """The run of each piece, why it cannot be made, or None where the time was over before."""
        pieces = list(pieces)
        missing = [p for p in dict.fromkeys(pieces) if p.key not in self.rows]
        if missing and time.perf_counter() < self.until:
            self._make(missing)
        return [_read(self.rows.get(p.key)) for p in pieces]

    def _make(self, pieces: Sequence[Piece]) -> None:
        left, running = list(reversed(pieces)), dict[Future[Any], Piece]()
        with open(self.file, "a") as file:
            while left or running:
                while left and len(running) < self.workers and time.perf_counter() < self.until:
                    piece = left.pop()
                    running[submit(self._pool, made, piece)] = piece
                if not running:
                    return
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    piece = running.pop(future)
                    self.rows[piece.key] = future.result()
                    file.write(json.dumps({"key": piece.key, "run": self.rows[piece.key]}, allow_nan=False) + "\n")
                    file.flush()
                    self.progress(f"{piece.key}; {len(left) + len(running)} to go ...")


def _read(row: dict[str, Any] | None) -> Run | str | None:
    return row if row is None else str(row["refused"]) if "refused" in row else Run.read(row)
