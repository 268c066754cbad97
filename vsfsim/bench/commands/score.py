"""`vsfsim lab score`: a file of predictions (`vsfsim.bench.predictions`) as a result."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.method import checked_prediction
from vsfsim.bench.predictions import questions
from vsfsim.bench.protocol import Answers, Trial
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.score import result_of
from vsfsim.core.errors import MethodError, no_such_file
from vsfsim.core.plain_text import plain
from vsfsim.data.dataset import Dataset

_LARGEST_NUMBER, _LARGEST_HEADER = 16, 10_000
"""Bytes of a number and of what stands before the numbers of an array in an .npz."""


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
    asked = [(Trial(q.name, q.shot, q.seed, ()), q.keys, q.actions) for q in questions(task, dataset)]
    given = read_predictions(path, {key: (len(action.time), action.size) for _, keys, actions in asked
                                     for key, action in zip(keys, actions, strict=True)})
    answers = [Answers(trial, tuple(checked_prediction([given[key] for key in keys], actions, keys)))
               for trial, keys, actions in asked]
    return result_of(answers, task, dataset, task.protocol.runs(seeded=False), method=plain(name),
                     entry="predictions file", notes=("scored from a file of predictions",), data=data)


def read_predictions(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """The arrays of an .npz, which must be of these keys and shapes. None is read that has more bytes than its shape
    needs, so that a file cannot make the reader allocate more.

    Raises:
        MethodError: it is no .npz, a key is missing or unknown, or an array is another one.
    """
    where, out = f"predictions {path}", {}
    try:
        with np.load(path, allow_pickle=False) as file:
            sizes = {info.filename.removesuffix(".npy"): info.file_size for info in file.zip.infolist()}
            for key in (*shapes, *sizes):
                if key not in sizes or key not in shapes:
                    raise MethodError(f"{where} have no '{key}'. One array (T, d) a query is needed; "
                                      f"`vsfsim.bench.predictions.questions` lists the keys." if key in shapes else
                                      f"{where} have '{plain(key, longest=100)}', which the task does not ask. Keys "
                                      f"are <object>/<shot>/<seed>/<touch>.")
            for key, shape in shapes.items():
                if sizes[key] > _LARGEST_NUMBER * math.prod(shape) + _LARGEST_HEADER:
                    raise MethodError(f"{where}: '{key}' has {sizes[key]} bytes; it must be real numbers of shape "
                                      f"(T, d) = {shape}.")
                out[key] = file[key]
    except MethodError:
        raise
    except Exception as error:  # NumPy and zipfile may raise anything on a damaged file
        raise MethodError(f"{where} cannot be read: {plain(error)}. Give an .npz as numpy.savez writes it.") from error
    return out
