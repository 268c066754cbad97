"""Whether a dataset is the one of a task: short fingerprints of everything that a method may see or is scored on.

A fingerprint of a vector v (n,) is its norm and three projections r_k . v on fixed vectors of signs. If two vectors
differ by d, each number differs by about |d|, so rounding changes them as little as it changes the data, and another
touch changes them as much as the touches differ (Johnson and Lindenstrauss 1984). Images are averaged in blocks first,
because rounding can move a pixel at an outline from the object to the background.

Fingerprints tell mistakes and lazy replacements from the task's data. They are no proof against somebody who computes
other data with the same fingerprints, nor against somebody who writes a result file by hand.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.protocol import divide, record
from vsfsim.bench.task import Task
from vsfsim.bench.trials.folds import shown_names, test_names
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain
from vsfsim.core.shape import probe_table
from vsfsim.core.shelf import folder
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.data.records import ObjectView, Touch, View

FORMAT = "vsfsim-task-record"
VERSION = 1
LARGEST_FILE = 16 << 20
"""A record with more bytes is not read."""

TOLERANCE = 1e-3
"""Largest relative difference of a fingerprint: rounding alone gives 1e-8 in a touch with a unique equilibrium, and
quantisation 1.2e-4; other seeds, scenes or physics differ by tens of per cent."""
IMAGE_TOLERANCE = 2e-2
"""The same for an image averaged in blocks: five flipped pixels on an outline give 0.4 %, another shoe 10 %."""
OTHER_MARKS = 0.02
"""Largest share of the touches of which a frame converged in one dataset and not in the other, with what it read: where
a frame ends at a limit of the solver, rounding decides (13 of the 1,440 frames of the bubble shoes do)."""
SMALLEST = 1e-2
"""A vector smaller than this fraction of the root mean square of its kind counts as that large: the readings of a touch
that met nothing are rounding error."""

_MARK = "converged frames"
_OF_MARKED = frozenset((_MARK, "reading", "skin", "skin's force"))
# points are a sample of the visible cloud: a pixel that rounding moves into another cell of the sample's grid moves a
# point or adds one, and all that follow have other places in the vector, so that only its norm can be compared
_SAMPLED = frozenset(("probed points", "probed stiffness"))
_OF_PIXELS = frozenset(("colour", "depth", "mask")) | _SAMPLED
_PROJECTIONS = 3
_BLOCK = 8  # pixels
_SCALE = 4096.0  # projections are stored as multiples of norm / _SCALE, within 8 norms
_ITEM = np.dtype([("norm", "<f4"), ("along", "<i2", (_PROJECTIONS,))])


@dataclass(frozen=True)
class Entry:
    """The fingerprints of one object view."""

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
    kinds: tuple[str, ...]
    """Of the vectors of the view, then of those of a touch."""
    of_view: np.ndarray
    """Fingerprints of the view (v,), structured."""
    of_touches: np.ndarray
    """Fingerprints of the touches (n, k), structured."""


@dataclass(frozen=True)
class Record:
    """The fingerprints of a dataset as one task reads it."""

    task: str
    """Name of the task."""
    task_sha256: str
    """Of its text."""
    dataset_sha256: str
    """Of the dataset's content."""
    made_by: Mapping[str, Any]
    """Version and commit that made the dataset."""
    entries: tuple[Entry, ...]
    """In the dataset's order, of the splits that the task uses."""

    def table(self) -> dict[str, Any]:
        """As JSON values; `read` takes them back."""
        rows = [{"name": e.name, "split": e.split, "object_index": e.object_index, "view_index": e.view_index,
                 "query": list(e.query), "kinds": list(e.kinds), "touches": len(e.of_touches),
                 "view": _text(e.of_view), "fingerprints": _text(e.of_touches)} for e in self.entries]
        return {"format": FORMAT, "version": VERSION, "task": self.task, "task_sha256": self.task_sha256,
                "dataset_sha256": self.dataset_sha256, "made_by": dict(self.made_by), "entries": rows}

    @classmethod
    def read(cls, table: Any, where: str) -> Record:
        """From JSON values.

        Raises:
            TaskError: they are not a record.
        """
        try:
            if table["format"] != FORMAT or table["version"] != VERSION:
                raise ValueError(f"format {plain(table['format'])}, version {plain(table['version'])}")
            entries = tuple(_entry(row) for row in table["entries"])
            texts = [table[key] for key in ("task", "task_sha256", "dataset_sha256")]
            if not all(isinstance(text, str) for text in texts) or not isinstance(table["made_by"], dict):
                raise ValueError("a text is missing")
            return cls(table["task"], table["task_sha256"], table["dataset_sha256"], table["made_by"], entries)
        except (KeyError, TypeError, ValueError, IndexError, binascii.Error, OverflowError) as error:
            raise TaskError(f"{where} is no record of a task's dataset: {plain(error)}. Make it again with `vsfsim "
                            f"tasks --record FOLDER`.") from error


def make_record(task: Task, dataset: Dataset) -> Record:
    """The record of ``dataset`` as ``task`` reads it.

    Raises:
        TaskError: the dataset does not fit the task.
    """
    asked = frozenset(test_names(dataset, task.protocol))
    return Record(task.name, task.sha256, dataset.sha256, dict(dataset.made_by),
                  tuple(_of_view(dataset.load(name), task, name in asked)
                        for name in shown_names(dataset, task.protocol)))


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
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ValueError(f"it has more than {LARGEST_FILE} bytes")
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise TaskError(f"{path} cannot be read: {plain(error)}. Restore the file.") from error
    found = Record.read(table, str(path))
    return found if (found.task, found.task_sha256) == (task.name, task.sha256) else None


def write_record(task: Task, dataset: Dataset, path: Path) -> Record:
    """Make the record of a task's dataset and write it.

    Raises:
        TaskError: the dataset does not fit, or the file cannot be written.
    """
    made = make_record(task, dataset)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, (json.dumps(made.table()) + "\n").encode(), error=TaskError)
    return made


def beside_record(task: Task, dataset: Dataset) -> dict[str, Any]:
    """What a result says of its dataset: its own record where its bits are not those of the shipped one, else {}."""
    known = shipped_record(task)
    if known is None or known.dataset_sha256 == dataset.sha256:
        return {}
    return make_record(task, dataset).table()


def differences(found: Record, known: Record) -> list[str]:
    """What is different in ``found`` from the record ``known``: a phrase a difference, [] if it is the same data."""
    out = []
    mine, theirs = ([(e.name, e.split, e.object_index, e.view_index) for e in r.entries] for r in (found, known))
    if mine != theirs:
        odd = [entry[0] for entry in mine if entry not in theirs] or [entry[0] for entry in theirs if entry not in mine]
        which = f", e.g. {plain(odd[0])}" if odd else ""
        return [f"its object views or their splits are others{which}"]
    floors = _floors(known)
    touches = views = marks = 0
    first_view = first_touch = ""
    for one, other in zip(found.entries, known.entries, strict=True):
        if one.kinds != other.kinds or one.of_touches.shape != other.of_touches.shape or (
                one.of_view.shape != other.of_view.shape) or one.query != other.query:
            return [f"{plain(one.name)} has other touches or other readings"]
        count = len(one.of_view)
        wrong = [kind for kind, a, b in zip(one.kinds[:count], one.of_view, other.of_view, strict=True)
                 if not _same(a, b, kind, floors)]
        views += bool(wrong)
        first_view = first_view or (f"{one.name}: {wrong[0]}" if wrong else "")
        for index, (a_row, b_row) in enumerate(zip(one.of_touches, other.of_touches, strict=True)):
            odd = [kind for kind, a, b in zip(one.kinds[count:], a_row, b_row, strict=True)
                   if not _same(a, b, kind, floors)]
            if _MARK in odd and _OF_MARKED.issuperset(odd):
                marks += 1
                continue
            touches += bool(odd)
            first_touch = first_touch or (f"{one.name} touch {index}: {odd[0]}" if odd else "")
    if views:
        out.append(f"{views} of {len(known.entries)} views differ ({plain(first_view)})")
    total = sum(len(e.of_touches) for e in known.entries)
    if touches:
        out.append(f"{touches} of {total} touches differ ({plain(first_touch)})")
    if marks > OTHER_MARKS * total:
        out.append(f"{marks} of {total} touches have other frames that did not converge")
    return out


# ---------------------------------------------------------------------- vectors


def _of_view(view: ObjectView, task: Task, asked: bool) -> Entry:
    recording = record(view, task)
    query = divide(view, task.protocol).query if asked else ()
    shown = dict(_vectors_of_view(view))
    rows = [dict(_vectors_of_touch(touch, clean)) for touch, clean in zip(view.touches, recording.clean, strict=True)]
    kinds = tuple(rows[0]) if rows else ()
    return Entry(view.name, view.split, view.object_index, view.view_index, query, (*shown, *kinds),
                 np.array([_print(v) for v in shown.values()], _ITEM),
                 np.array([[_print(row[kind]) for kind in kinds] for row in rows], _ITEM).reshape(len(rows),
                                                                                                  len(kinds)))


def _vectors_of_view(view: ObjectView) -> Iterator[tuple[str, np.ndarray]]:
    image: View = view.view
    for name, values in (("colour", image.rgb), ("depth", image.depth), ("mask", image.mask)):
        yield name, _in_blocks(np.asarray(values, float))
    yield "intrinsics", image.intrinsics
    yield "camera's rotation", image.camera_pose[:3, :3]
    yield "camera's position", image.camera_pose[:3, 3]
    yield "probe", np.array(list(_numbers(probe_table(view.probe))))
    if view.truth is not None:
        yield "probed points", view.truth.probe_points
        yield "probed stiffness", view.truth.probe_stiffness


def _vectors_of_touch(touch: Touch, clean: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    yield "time", touch.time
    yield "rotation", touch.mount_pose[:, :3, :3]
    yield "position", touch.mount_pose[:, :3, 3]
    yield "direction", touch.axis
    yield _MARK, touch.converged
    yield "reading", np.nan_to_num(clean)
    yield "joint angles", np.zeros(0) if touch.q is None else touch.q
    if touch.planned_pose is not None and touch.planned_frame is not None:
        yield "plan", touch.planned_pose
        yield "frames as planned", touch.planned_frame
    for name, values in (("skin", touch.node_position), ("skin's force", touch.node_force)):
        yield name, np.zeros(0) if values is None else np.nan_to_num(values)


def _in_blocks(image: np.ndarray) -> np.ndarray:
    """Means over blocks of 8 x 8 pixels of an image (H, W) or (H, W, c)."""
    height, width = (n // _BLOCK * _BLOCK for n in image.shape[:2])
    cut = image[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK, -1)
    return cut.mean(axis=(1, 3))


def _numbers(item: Any) -> Iterator[float]:
    if isinstance(item, Mapping):
        for key in sorted(item):
            yield from _numbers(item[key])
    elif isinstance(item, (list, tuple)):
        for part in item:
            yield from _numbers(part)
    elif isinstance(item, (int, float)):
        yield float(item)


def _print(vector: np.ndarray) -> np.ndarray:
    v = np.asarray(vector, float).reshape(-1)
    norm = float(np.linalg.norm(v))
    along = [float(_signs(len(v), k) @ v) for k in range(_PROJECTIONS)] if norm > 0.0 else [0.0] * _PROJECTIONS
    out = np.zeros((), _ITEM)
    out["norm"] = norm
    out["along"] = np.clip(np.rint(_SCALE * np.array(along) / norm), -32767, 32767) if norm > 0.0 else 0
    return out


def _signs(size: int, number: int) -> np.ndarray:
    """The fixed vector of signs (size,); of a hash, because NumPy's generators may change."""
    bits = np.frombuffer(hashlib.shake_256(f"{number}:{size}".encode()).digest(-(-size // 8) or 1), np.uint8)
    return 2.0 * np.unpackbits(bits)[:size] - 1.0


def _floors(known: Record) -> dict[str, float]:
    sizes: dict[str, list[float]] = {}
    for entry in known.entries:
        count = len(entry.of_view)
        for kind, item in zip(entry.kinds[:count], entry.of_view, strict=True):
            sizes.setdefault(kind, []).append(float(item["norm"]))
        for column, kind in enumerate(entry.kinds[count:]):
            sizes.setdefault(kind, []).extend(float(n) for n in entry.of_touches[:, column]["norm"])
    return {kind: SMALLEST * float(np.sqrt(np.mean(np.square(norms)))) for kind, norms in sizes.items()}


def _same(a: np.void, b: np.void, kind: str, floors: Mapping[str, float]) -> bool:
    size = max(float(b["norm"]), floors[kind])
    apart = np.abs(np.concatenate([[float(a["norm"]) - float(b["norm"])], (
        float(a["norm"]) * a["along"].astype(float) - float(b["norm"]) * b["along"].astype(float)) / _SCALE]))
    tolerance = IMAGE_TOLERANCE if kind in _OF_PIXELS else TOLERANCE
    if kind in _SAMPLED:
        apart = apart[:1]
    return bool((apart <= tolerance * size).all())


def _text(items: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(items).tobytes()).decode()


def _entry(row: Mapping[str, Any]) -> Entry:
    kinds, count = tuple(row["kinds"]), int(row["touches"])
    if not all(isinstance(word, str) for word in (*kinds, row["name"], row["split"])):
        raise ValueError("a name is not text")
    of_view, flat = (_items(row[key]) for key in ("view", "fingerprints"))
    columns = len(kinds) - len(of_view)
    if columns < 0 or count < 0 or len(flat) != count * columns:
        raise ValueError(f"{row['name']}: the number of fingerprints does not fit")
    query: Sequence[Any] = row["query"]
    return Entry(row["name"], row["split"], int(row["object_index"]), int(row["view_index"]),
                 tuple(int(i) for i in query), kinds, of_view, flat.reshape(count, columns))


def _items(text: str) -> np.ndarray:
    items = np.frombuffer(base64.b64decode(text, validate=True), _ITEM)
    if not np.isfinite(items["norm"]).all() or (items["norm"] < 0.0).any():
        raise ValueError("a norm is not a number >= 0")
    return items
