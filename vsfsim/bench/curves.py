"""Predictions of query touches beside the truth, in one small .npz: what `vsfsim evaluate --keep predictions` writes
beside a result, and `vsfsim view RESULT` draws."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from vsfsim.bench.protocol import Answers, divide, record
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic

SUFFIX = ".predictions.npz"
"""In place of the .json of a result."""
_SINGLE = 1e-4  # relative difference of an error that single precision makes
_ARRAYS = ("objects", "touches", "start", "time", "truth", "shots", "seeds", "predicted")


@dataclass(frozen=True)
class Curves:
    """Q query touches with N frames in all, S shots and R runs."""

    objects: tuple[str, ...]
    """Name of the object view of each touch, Q of them."""
    touches: np.ndarray
    """Index of each touch in its view (Q,)."""
    start: np.ndarray
    """First frame of each touch, and N (Q + 1,)."""
    time: np.ndarray
    """Of the frames (N,) [s]."""
    truth: np.ndarray
    """Noise-free readings (N, d) in the task's unit; NaN in frames that are not scored."""
    shots: tuple[str, ...]
    """Labels."""
    seeds: tuple[int, ...]
    """Numbers of the runs."""
    predicted: np.ndarray
    """Readings that the method predicted (S, R, N, d)."""

    @classmethod
    def of(cls, answers: Iterable[Answers], task: Task, dataset: Dataset, seeds: tuple[int, ...]) -> Curves:
        """Of all answers of an evaluation; the truth is read here."""
        given = {(one.trial.subject, one.trial.shot, one.trial.seed): one.readings for one in answers}
        names = list(dict.fromkeys(name for name, _, _ in given))
        asked = []
        for name in names:
            view = dataset.load(name)
            recording = record(view, task)
            asked += [(name, index, recording.queries[index]) for index in divide(view, task.protocol).query]
        times = [query.action.time for _, _, query in asked]
        predicted = np.stack([np.stack([np.concatenate([reading for name in names for reading in given[name, shot, run]
                                                        ]) for run in seeds]) for shot in task.protocol.labels])
        return cls(tuple(name for name, _, _ in asked), np.array([index for _, index, _ in asked]),
                   np.cumsum([0, *map(len, times)]), np.concatenate(times),
                   np.concatenate([np.where(query.scored[:, None], query.clean, np.nan) for _, _, query in asked]),
                   task.protocol.labels, seeds, predicted)

    def save(self, path: Path) -> None:
        """Write them in single precision; the file appears whole or not at all.

        Raises:
            TaskError: it cannot be written.
        """
        out = io.BytesIO()
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        np.savez_compressed(out, **{  # type: ignore[arg-type]
            name: array.astype(np.float32) if array.dtype.kind == "f" else array for name, array in arrays.items()})
        write_atomic(path, out.getvalue(), error=TaskError)

    @classmethod
    def beside(cls, result: Result, path: Path) -> Curves | None:
        """The curves beside a result file ``path``; None where there are none.

        Raises:
            TaskError: the file is damaged, or is of another evaluation.
        """
        path = beside(path)
        if not path.is_file():
            return None
        again = "Evaluate again with --keep predictions, or remove the file."
        try:
            with np.load(path, allow_pickle=False) as file:
                a = {name: file[name] for name in _ARRAYS}
            found = cls(tuple(map(str, a["objects"].tolist())), a["touches"], a["start"], a["time"], a["truth"],
                        tuple(map(str, a["shots"].tolist())), tuple(map(int, a["seeds"].tolist())), a["predicted"])
            errors = found.errors()
        except (OSError, ValueError, KeyError, TypeError, BadZipFile, EOFError, IndexError) as error:
            raise TaskError(f"{path} cannot be read: {error}. {again}") from error
        q = result.queries
        known = {(name, touch, shot, seed): math.sqrt(sse / n) for name, touch, shot, seed, sse, n in zip(
            *(q[key] for key in ("object", "touch", "shot", "seed", "sse", "n")), strict=True)}
        if errors.keys() != known.keys() or any(
                not math.isclose(errors[key], known[key], rel_tol=_SINGLE, abs_tol=_SINGLE) for key in known):
            raise TaskError(f"{path} is of another evaluation than the result beside it. {again}")
        return found

    def parts(self) -> Iterator[tuple[str, int, slice]]:
        """Object view, touch and frames of each query touch."""
        for k, (name, touch) in enumerate(zip(self.objects, self.touches.tolist(), strict=True)):
            yield name, touch, slice(int(self.start[k]), int(self.start[k + 1]))

    def errors(self) -> dict[tuple[str, int, str, int], float]:
        """Root mean square error by object view, touch, shot and run, in the task's unit."""
        out: dict[tuple[str, int, str, int], float] = {}
        for name, touch, frames in self.parts():
            error = np.sqrt(np.nanmean((self.predicted[:, :, frames] - self.truth[frames]) ** 2, axis=(2, 3)))
            out |= {(name, touch, shot, run): float(error[s, r]) for s, shot in enumerate(self.shots)
                    for r, run in enumerate(self.seeds)}
        return out


def beside(result: Path) -> Path:
    """The file of predictions of a result file."""
    return result.with_name(result.name.removesuffix(".json") + SUFFIX)
