"""Predictions of query touches beside the truth, in one small .npz: what `vsfsim evaluate --keep predictions` writes
beside a result, and `vsfsim show RESULT --out page.html` draws."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from vsfsim.bench.protocol import Answers, divide, record
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic

_SINGLE = 1e-4  # relative difference of an error that single precision makes
Curves = dict[tuple[str, int], tuple[np.ndarray, np.ndarray]]
"""Of each query touch, by the name of its object view and its index there: the noise-free readings (T, d) in the task's
unit, NaN in frames that are not scored, and the readings that the method predicted at S shots in R runs (S, R, T, d).
The arrays of the file are called ``OBJECT/TOUCH/truth`` and ``OBJECT/TOUCH/predicted``."""


def save(answers: Iterable[Answers], task: Task, dataset: Dataset, seeds: tuple[int, ...], result: Path) -> None:
    """Write all answers of an evaluation, in single precision, beside its result file; the truth is read here.

    Raises:
        TaskError: the file cannot be written.
    """
    given = {(one.trial.subject, one.trial.shot, one.trial.seed): one.readings for one in answers}
    arrays, out = {}, io.BytesIO()
    for name in dict.fromkeys(name for name, _, _ in given):
        view = dataset.load(name)
        queries = record(view, task).queries
        for k, touch in enumerate(divide(view, task.protocol).query):
            arrays[f"{name}/{touch}/truth"] = np.where(queries[touch].scored[:, None], queries[touch].clean, np.nan)
            arrays[f"{name}/{touch}/predicted"] = np.array([
                [given[name, shot, run][k] for run in seeds] for shot in task.protocol.labels])
    np.savez_compressed(out, **{name: array.astype(np.float32) for name, array in arrays.items()})  # type: ignore
    write_atomic(beside(result), out.getvalue(), error=TaskError)


def load(result: Result, path: Path) -> Curves | None:
    """The curves beside a result file ``path``; None where there are none.

    Raises:
        TaskError: the file is damaged, or is of another evaluation.
    """
    path = beside(path)
    if not path.is_file():
        return None
    rows, again = result.rows, "Evaluate again with --keep predictions, or remove the file."
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {(name, touch): (file[f"{name}/{touch}/truth"], file[f"{name}/{touch}/predicted"])
                     for name, touch in dict.fromkeys((row["object"], row["touch"]) for row in rows)}
        errors = {touch: np.sqrt(np.nanmean((predicted - truth) ** 2, axis=(2, 3)))
                  for touch, (truth, predicted) in found.items()}
        same = all(math.isclose(math.sqrt(row["sse"] / row["n"]), errors[row["object"], row["touch"]][
            result.shots.index(row["shot"]), result.seeds.index(row["seed"])], rel_tol=_SINGLE, abs_tol=_SINGLE)
            for row in rows)
    except (OSError, ValueError, KeyError, TypeError, BadZipFile, EOFError, IndexError) as error:
        raise TaskError(f"{path} cannot be read: {error}. {again}") from error
    if not same:
        raise TaskError(f"{path} is of another evaluation than the result beside it. {again}")
    return found


def beside(result: Path) -> Path:
    """The file of predictions of a result file."""
    return result.with_name(result.name.removesuffix(".json") + ".predictions.npz")
