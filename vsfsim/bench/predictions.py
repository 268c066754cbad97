"""Scoring a file of predictions, for methods that run elsewhere (another language, another machine).

The file is an .npz with one array (T, d) for every query: its key is ``<object>/<shot>/<seed>/<touch>``, e.g.
``shoe-0004-v0/5/0/011``. `questions` lists them together with the touches that may be used for each.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from zipfile import BadZipFile, ZipFile

import numpy as np

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.method import Action, Reading, checked_prediction, frozen_view
from vsfsim.bench.protocol import Answers, Trial, divide, folds_of, record, support
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.score import result_of
from vsfsim.core.errors import MethodError, no_such_file
from vsfsim.core.plain_text import plain
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import View


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
    support: tuple[Reading, ...]
    """Touches that the method may learn from."""
    touches: tuple[int, ...]
    """Indices of the query touches."""
    actions: tuple[Action, ...]
    """Of the query touches."""
    train: tuple[str, ...] = ()
    """Names of the object views that the answers may be learned from; with cross-validation others in every fold."""

    @property
    def keys(self) -> tuple[str, ...]:
        """Names of the answers in the file, one a query touch."""
        return tuple(f"{self.name}/{self.shot}/{self.seed}/{touch:03d}" for touch in self.touches)


def questions(task: Task, dataset: Dataset) -> Iterator[Question]:
    """All adaptations that the task asks for, in order, without a reading of a query touch."""
    for fold in folds_of(dataset, task.protocol):
        for view in map(dataset.blind().load, fold.test):
            recording, draw, shown = record(view, task), divide(view, task.protocol), frozen_view(view.view)
            actions = tuple(recording.queries[i].action for i in draw.query)
            for seed in task.protocol.runs(seeded=False):
                for label in task.protocol.labels:
                    chosen = support(view, draw, label, seed, task.protocol)
                    yield Question(view.name, label, seed, shown, tuple(recording.readings[i] for i in chosen),
                                   draw.query, actions, fold.train)


def score_predictions(path: str | Path, task: Task, dataset: Dataset, *, name: str) -> Result:
    """Score the predictions in ``path``; ``name`` is what the method is called in the result.

    Raises:
        MethodError: the file is not an .npz, a key is missing or unknown, or a prediction has the wrong shape, is not
            made of real numbers, or is not finite.
    """
    path = Path(path)
    if not path.exists():
        raise MethodError(no_such_file("file of predictions", path))
    data = fingerprint.beside_record(task, dataset)
    answers: dict[str, list[Answers]] = {}
    asked: set[str] = set()
    with PredictionFile(path) as given:
        for question in questions(task, dataset):
            shapes = [(len(action.time), action.size) for action in question.actions]
            read = [given.read(key, shape) for key, shape in zip(question.keys, shapes, strict=True)]
            predictions = checked_prediction(read, question.actions, question.keys)
            trial = Trial(question.name, question.shot, question.seed, ())
            answers.setdefault(question.name, []).append(Answers(trial, tuple(predictions)))
            asked.update(question.keys)
        for key in given.keys:
            if key not in asked:
                raise MethodError(f"predictions {path} have '{plain(key, longest=100)}', which the task does not ask. "
                                  f"Keys are <object>/<shot>/<seed>/<touch>.")
    every = [one for mine in answers.values() for one in mine]
    return result_of(every, task, dataset, task.protocol.runs(seeded=False), method=plain(name),
                     entry="predictions file", notes=("scored from a file of predictions",), data=data)


class PredictionFile:
    """An .npz of predictions. An array is read only if its header says the shape that was asked for, so that a file
    cannot make the reader allocate more.

    Args:
        path: the file.

    Raises:
        MethodError: it is no .npz.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            self._file = ZipFile(path)
        except (OSError, ValueError, BadZipFile, NotImplementedError) as error:
            raise MethodError(f"predictions {path} cannot be read: {plain(error)}. Give an .npz as "
                              f"numpy.savez writes it.") from error
        self.keys = [name.removesuffix(".npy") for name in self._file.namelist()]

    def __enter__(self) -> PredictionFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """The array called ``key``, which must have this shape and hold real numbers.

        Raises:
            MethodError: there is none, or it is another one.
        """
        if key not in self.keys:
            raise MethodError(f"predictions {self.path} have no '{key}'. One array (T, d) a query is needed; "
                              f"`vsfsim.bench.predictions.questions` lists the keys.")
        try:
            with self._file.open(f"{key}.npy") as file:
                version = np.lib.format.read_magic(file)
                header = np.lib.format.read_array_header_1_0 if version == (1, 0) else (
                    np.lib.format.read_array_header_2_0)
                found, fortran, dtype = header(file)
                if dtype.kind not in "fiub" or found != shape:
                    raise MethodError(f"predictions {self.path}: '{key}' has shape {found} and dtype {dtype}; it must "
                                      f"be real numbers of shape (T, d) = {shape}.")
                size = int(np.prod(shape)) * dtype.itemsize
                content = file.read(size)
        except (OSError, ValueError, EOFError, KeyError, BadZipFile, NotImplementedError, RuntimeError, SyntaxError,
                TypeError, TokenError, zlib.error, lzma.LZMAError) as error:  # numpy parses a header as Python
            raise MethodError(f"predictions {self.path}: '{key}' cannot be read: {plain(error)}. Write the file "
                              f"again.") from error
        if len(content) != size:
            raise MethodError(f"predictions {self.path}: '{key}' ends after {len(content)} of {size} bytes. Write the "
                              f"file again.")
        return np.frombuffer(content, dtype).reshape(shape, order="F" if fortran else "C")
