"""The record of a task's dataset: short fingerprints of its pictures, and of the direction and the readings of each
touch. A touch at another place, of another object or by another probe reads otherwise.

A fingerprint of a vector v (n,) is its norm and three projections r_k . v on fixed vectors of signs. If two vectors
differ by d, each number differs by about |d|, so rounding changes them as little as it changes the data, and another
touch changes them as much as the touches differ (Johnson and Lindenstrauss 1984). Images are averaged in blocks first,
because rounding can move a pixel at an outline from the object to the background. Two records are compared by
`vsfsim.bench.admission.admit`.

Fingerprints tell mistakes and lazy replacements from the task's data. They are no proof against somebody who computes
other data with the same fingerprints, nor against somebody who writes a result file by hand.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from vsfsim.bench.protocol import divide, folds_of, record, share_unresolved
from vsfsim.bench.result_file import pack, read_record, unpack
from vsfsim.bench.task import Task
from vsfsim.core.shelf import folder
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import Touch

KIND = "record of a dataset as `vsfsim measure record FOLDER` writes it"
_BLOCK = 8  # pixels
SCALE = 4096.0
"""Projections are stored as multiples of norm / SCALE, within 8 norms."""
IMAGES, DIRECTION, READING = ("colour", "depth"), "direction", "reading"
"""Kinds of vectors: two of an object view, the press direction of a touch, and its noise-free readings."""
_PROJECTIONS = ("along_0", "along_1", "along_2")
_COLUMNS = ("view", "touch", "kind", "norm", *_PROJECTIONS)


class Entry(msgspec.Struct, frozen=True):
    """One object view."""

    name: str
    """Of the object view."""
    split: str
    """"train", "test", ..."""
    object_index: int
    """From 0."""
    view_index: int
    """Of the view of that object, from 0."""
    query: tuple[int, ...]
    """Its query touches; empty outside the test split."""


class Record(msgspec.Struct, frozen=True, omit_defaults=True):
    """The fingerprints of a dataset as one task reads it."""

    format: Literal["vsfsim-task-record"]
    version: Literal[3]
    task: str
    """Name of the task."""
    task_sha256: str
    """Of its text."""
    dataset_sha256: str
    """Of the dataset's content."""
    made_by: dict[str, Any]
    """Version and commit that made the dataset."""
    entries: tuple[Entry, ...]
    """In the dataset's order, of the splits that the task uses."""
    vectors: dict[str, Any]
    """Fingerprints, packed (`vsfsim.bench.result_file.pack`): columns with one row a vector, its view, its touch from 1
    on (0 for what is of the view), its kind, its norm and its projections [norm / `SCALE`]."""
    unresolved: tuple[int, int, float] | None = None
    """Of the frames of query touches (`vsfsim.bench.protocol.share_unresolved`); None where it was not measured."""
    again: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    """Share of the same planned touches that read otherwise where another machine made them, as far as that was
    measured: rounding decides which of several equilibria an object reaches, as when a branch snaps off a link [-]."""
    repeat: float = 0.0
    """Of recordings: how well the same places, pressed on another day, foretell the readings (error over that of
    predicting zero, mean over the objects that were pressed twice) [-]; 0 where none was."""

    def table(self) -> dict[str, Any]:
        """As JSON values; msgspec converts them back."""
        return msgspec.to_builtins(self)

    def fingerprints(self) -> tuple[list[tuple[Any, ...]], np.ndarray, np.ndarray]:
        """View, touch and kind of each vector; norms (n,); and projections (n, 3).

        Raises:
            ValueError, KeyError, TypeError: they are malformed.
        """
        columns = unpack(self.vectors)
        of = list(zip(*(columns[name] for name in _COLUMNS[:3]), strict=True))
        norm, *along = (np.array(columns[name], float).reshape(len(of)) for name in _COLUMNS[3:])
        if not (norm >= 0.0).all() or not np.isfinite(along).all():
            raise ValueError("a norm is not a number >= 0, or a projection no number")
        return of, norm, np.stack(along, axis=1)


def make_record(task: Task, dataset: Dataset) -> Record:
    """The record of ``dataset`` as ``task`` reads it.

    Raises:
        TaskError: the dataset does not fit the task.
    """
    folds = folds_of(dataset, task.protocol)
    asked = [name for fold in folds for name in fold.test]
    entries, rows, queries = list[Entry](), list[tuple[Any, ...]](), list[Touch]()
    for name in dict.fromkeys([*(name for fold in folds for name in fold.train), *asked]):
        view = dataset.load(name)
        query = divide(view, task.protocol).query if name in asked else ()
        entries.append(Entry(view.name, view.split, view.object_index, view.view_index, query))
        queries += [view.touches[k] for k in query]
        rows += [(name, 0, kind, *_print(_in_blocks(np.asarray(image, float)))) for kind, image in zip(
            IMAGES, (view.view.rgb, view.view.depth), strict=True)]
        for k, (touch, clean) in enumerate(zip(view.touches, record(view, task).clean, strict=True), start=1):
            rows += [(name, k, DIRECTION, *_print(touch.axis)), (name, k, READING, *_print(np.nan_to_num(clean)))]
    vectors = pack(dict(zip(_COLUMNS, map(list, zip(*rows, strict=True)), strict=True)))
    days = [one["rmse_ratio"] for one in dataset.recipe.options.get("again", {}).values()]
    return Record("vsfsim-task-record", 3, task.name, task.sha256, dataset.sha256, dict(dataset.made_by),
                  tuple(entries), vectors, share_unresolved(queries), repeat=sum(days) / max(len(days), 1))


def record_path(task: Task) -> Path:
    """Where the shipped record of a task lies."""
    return folder("tasks") / "records" / f"{task.name}.json"


def shipped_record(task: Task) -> Record | None:
    """The record that ships with a task; None if there is none, or it is of another text of the task.

    Raises:
        TaskError: the file is damaged.
    """
    path = record_path(task)
    if not path.is_file():
        return None
    found = read_record(path, Record, KIND)
    return found if (found.task, found.task_sha256) == (task.name, task.sha256) else None


def beside_record(task: Task, dataset: Dataset) -> dict[str, Any]:
    """What a result says of its dataset: its own record where its bits are not those of the shipped one, else {}."""
    known = shipped_record(task)
    if known is None or known.dataset_sha256 == dataset.sha256:
        return {}
    return make_record(task, dataset).table()


def _in_blocks(image: np.ndarray) -> np.ndarray:
    """Means over blocks of 8 x 8 pixels of an image (H, W) or (H, W, c)."""
    height, width = (n // _BLOCK * _BLOCK for n in image.shape[:2])
    cut = image[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, -1)
    return cut.mean(axis=(1, 3))


def _print(vector: np.ndarray) -> list[float]:
    """Norm and projections."""
    v = np.asarray(vector, float).reshape(-1)
    norm = float(np.linalg.norm(v))
    along = np.array([float(_signs(len(v), k) @ v) for k in range(len(_PROJECTIONS))]) / (norm or 1.0)
    return [float(np.float32(norm)), *np.clip(np.rint(SCALE * along), -32767, 32767).tolist()]


def _signs(size: int, number: int) -> np.ndarray:
    """The fixed vector of signs (size,); of a hash, because NumPy's generators may change."""
    bits = np.frombuffer(hashlib.shake_256(f"{number}:{size}".encode()).digest(-(-size // 8) or 1), np.uint8)
    return 2.0 * np.unpackbits(bits)[:size] - 1.0
