"""What a task asks of a method that runs elsewhere (another language, another machine), and its file of predictions.

The file is an .npz with one array (T, d) for every query: its key is ``<object>/<shot>/<seed>/<touch>``, e.g.
``shoe-0004-v0/5/0/011``. `questions` lists them together with the touches that may be used for each, of a dataset or of
the public part of a sealed set.

A sealed set is the public part of a dataset, a private part that scores answers to it, and a commitment to both. The
public folder holds what a method may see of every object: the picture, the support touches with the task's noise, and
the paths of the query touches. The private file holds a text with the identity of the dataset, its seed and a random
word. The sha256 of that text is in the public part, so that whoever seals a set cannot change it afterwards, and nobody
can guess the seed. The dataset itself stays with them, because it holds the query readings and the truth.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from zipfile import BadZipFile

import msgspec
import numpy as np

from vsfsim.bench.method import Action, Reading, Surface, frozen_view
from vsfsim.bench.protocol import divide, folds_of, record, support
from vsfsim.bench.result_file import read_record, write_record
from vsfsim.bench.task import Task
from vsfsim.core.errors import SceneError, TaskError
from vsfsim.core.plain_text import from_json, plain
from vsfsim.core.shape import parse_probe_shapes, probe_table
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.data.records import View
from vsfsim.data.safety import check_name

INDEX, _PART = "sealed.json", "part of a sealed set as `lab seal` writes it"
FEWEST_SEEDS = 10**11
"""A smaller seed can be found by making an object of each and comparing pictures."""
_VIEW = ("rgb", "depth", "mask", "intrinsics", "camera_pose")


@dataclass(frozen=True)
class Question:
    """One adaptation that the task asks for."""

    name: str
    """Of the object view."""
    shot: str
    """Label of the shot."""
    seed: int
    """Of the support draw."""
    view: View
    """Of the object."""
    given: tuple[int, ...]
    """Indices of the touches that the method may learn from."""
    support: tuple[Reading, ...]
    """These touches."""
    touches: tuple[int, ...]
    """Indices of the query touches."""
    actions: tuple[Action, ...]
    """Of the query touches."""
    train: tuple[str, ...] = ()
    """Names of the object views that the answers may be learned from, with cross-validation others in every fold; none
    of a sealed set, whose method learns from other data first."""

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the answers in the file, one a query touch."""
        return tuple(f"{self.name}/{self.shot}/{self.seed}/{touch:03d}" for touch in self.touches)


def questions(task: Task, source: Dataset | Path) -> Iterator[Question]:
    """All adaptations that the task asks for, in order, without a reading of a query touch.

    Args:
        task: the task. source: its dataset, or the public folder of a sealed set.

    Raises:
        TaskError: the folder is no sealed set of this task, or a file of it was changed.
    """
    if isinstance(source, Dataset):
        for fold in folds_of(source, task.protocol):
            for view in map(source.blind().load, fold.test):
                recording, draw, shown = record(view, task), divide(view, task.protocol), frozen_view(view.view)
                actions = tuple(recording.queries[k].action for k in draw.query)
                for run, label in itertools.product(task.protocol.runs(seeded=False), task.protocol.labels):
                    given = support(view, draw, label, run, task.protocol)
                    yield Question(view.name, label, run, shown, given, tuple(recording.readings[k] for k in given),
                                   draw.query, actions, fold.train)
        return
    index = read_record(source / INDEX, _Index, _PART)
    if index.task_sha256 != task.sha256:
        raise TaskError(f"{source} is a sealed set of task {plain(index.task)}, not of this text of {task.name}.")
    for file, sha256 in index.files.items():
        yield from _unsealed(source / check_name(file, str(source / INDEX)), sha256, task)


def seal(task: Task, dataset: Dataset, public: Path, private: Path) -> str:
    """Write the public part into a new folder and the private one into a new file.

    Returns:
        The commitment.

    Raises:
        TaskError: the folder or the file exists, or cannot be written.
    """
    for path in (public, private):
        if path.exists():
            raise TaskError(f"{path} exists already. Choose another name, or remove it first.")
    if public.resolve() in private.resolve().parents:
        raise TaskError(f"{private} would lie in the public folder {public}. Choose another place for the private "
                        f"part.")
    text = json.dumps({"dataset_sha256": dataset.sha256, "scene": dataset.recipe.scene, "seed": dataset.recipe.seed,
                       "task_sha256": task.sha256, "word": secrets.token_hex(16)}, sort_keys=True)
    commitment = hashlib.sha256(text.encode()).hexdigest()
    write_record(private, _Private("vsfsim-sealed-private", 1, commitment, text))
    files = {}
    for number, (_, asked) in enumerate(itertools.groupby(questions(task, dataset), lambda one: one.name)):
        content = _public_part(list(asked))
        write_atomic(public / f"object-{number:04d}.npz", content, error=TaskError)
        files[f"object-{number:04d}.npz"] = hashlib.sha256(content).hexdigest()
    write_record(public / INDEX, _Index("vsfsim-sealed", 2, task.name, task.sha256, commitment, files))
    return commitment


def check_commitment(private: Path, task: Task, dataset: Dataset) -> None:
    """Refuse a private part that is not that of a task and its dataset, or does not keep its commitment.

    Raises:
        TaskError: with what differs.
    """
    part = read_record(private, _Private, _PART)
    if hashlib.sha256(part.text.encode()).hexdigest() != part.commitment:
        raise TaskError(f"{private} does not keep its commitment: the sha256 of its text is another one.")
    try:
        said = from_json(part.text)
        pairs = {"task_sha256": task.sha256, "dataset_sha256": dataset.sha256, "seed": dataset.recipe.seed}
        odd = [key for key, value in pairs.items() if said[key] != value]
    except (ValueError, KeyError, TypeError) as error:
        raise TaskError(f"{private}: its text is not that of a sealed set ({plain(error)}).") from error
    if odd:
        raise TaskError(f"{private} is not of this task and dataset: {' and '.join(odd)} differ.")


def receipt(private: Path, row_sha256: str) -> dict[str, str]:
    """That whoever holds a private part has scored a row against it: its commitment, and the sha256 of its text with
    that of the row, which nobody else can make and everybody can check once the text is published.

    Raises:
        TaskError: the file is no private part.
    """
    part = read_record(private, _Private, _PART)
    return {"commitment": part.commitment,
            "receipt": hashlib.sha256(f"{part.text}{row_sha256}".encode()).hexdigest()}


def _public_part(asked: Sequence[Question]) -> bytes:
    """The questions about one object view."""
    one = asked[0]
    actions, arrays = dict(zip(one.touches, one.actions, strict=True)), {key: getattr(one.view, key) for key in _VIEW}
    for k, reading in ((k, reading) for q in asked for k, reading in zip(q.given, q.support, strict=True)):
        actions[k] = reading.action
        arrays |= {f"{k}/value": reading.value, f"{k}/valid": reading.valid}
        if reading.surface is not None:
            arrays |= {f"{k}/vertices": reading.surface.vertices, f"{k}/node_force": reading.surface.force}
    for k, action in actions.items():
        arrays |= {f"{k}/time": action.time, f"{k}/poses": action.poses, f"{k}/axis": action.axis}
        arrays |= {f"{k}/q": action.q} if action.q is not None else {}
    head = {"name": one.name, "query": one.touches, "asked": [(q.shot, q.seed, q.given) for q in asked],
            "probes": {k: (probe_table(action.probe), action.mount_stiffness) for k, action in actions.items()}}
    # a number that was read from HDF5 is an array without axes
    arrays["head"] = np.frombuffer(json.dumps(head, default=np.ndarray.item).encode(), np.uint8)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def _unsealed(path: Path, sha256: str, task: Task) -> list[Question]:
    """What `_public_part` wrote."""
    try:
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != sha256:
            raise TaskError(f"{path} was changed after the set was sealed: its sha256 is another one.")
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = dict(file)
        head, row = from_json(arrays.pop("head").tobytes()), task.observation
        shown, query = frozen_view(View(**{key: arrays[key] for key in _VIEW})), tuple(head["query"])
        actions = {int(k): Action(arrays[f"{k}/time"], arrays[f"{k}/poses"], arrays[f"{k}/axis"],
                                  parse_probe_shapes(probe, str(path))[0], row.name, row.size, arrays.get(f"{k}/q"),
                                  spring)
                   for k, (probe, spring) in head["probes"].items()}
        surfaces = {k: Surface(arrays[f"{k}/vertices"], arrays[f"{k}/node_force"])
                    for k in actions if f"{k}/vertices" in arrays}
        readings = {k: Reading(action, arrays[f"{k}/value"], arrays[f"{k}/valid"], surfaces.get(k))
                    for k, action in actions.items() if f"{k}/value" in arrays}
        return [Question(check_name(head["name"], str(path)), shot, seed, shown, tuple(given),
                         tuple(readings[k] for k in given), query, tuple(actions[k] for k in query))
                for shot, seed, given in head["asked"]]
    except (OSError, ValueError, LookupError, TypeError, AttributeError, BadZipFile, EOFError, SceneError) as error:
        raise TaskError(f"{path} cannot be read as an object of a sealed set: {plain(error)}.") from error


class _Private(msgspec.Struct):
    format: Literal["vsfsim-sealed-private"]
    version: Literal[1]
    commitment: str
    text: str


class _Index(msgspec.Struct):
    format: Literal["vsfsim-sealed"]
    version: Literal[2]
    task: str
    task_sha256: str
    commitment: str
    files: dict[str, str]
