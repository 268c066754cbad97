"""What a method answered in one trial, checked by the scorer, and kept on disk until all trials are done."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from vsfsim.bench.isolation.process import MethodProcess
from vsfsim.bench.isolation.process import Trial as Asked
from vsfsim.bench.method import LARGEST_READING, checked_choice
from vsfsim.bench.trials.subject import Subject, Trial
from vsfsim.core.errors import MethodError
from vsfsim.core.plain_text import from_json
from vsfsim.data.disk import write_atomic


@dataclass(frozen=True)
class Answers:
    """The answers of one trial; an optional one is None where the method or the task has none."""

    trial: Trial
    """Which."""
    readings: tuple[np.ndarray, ...]
    """Predicted (T, d), one a query touch."""
    readings_std: tuple[np.ndarray, ...] | None
    """Their standard deviations (T, d)."""
    mean: np.ndarray | None
    """Stiffness at `Subject.points` (k,)."""
    std: np.ndarray | None
    """Its standard deviation (k,)."""
    column_mean: np.ndarray | None
    """Stiffness at `Subject.columns` (q,)."""
    pose: np.ndarray | None
    """Object-to-world transform (4, 4) of the hidden object."""
    adapt_s: float
    """Seconds of `adapt`."""
    predict_s: float
    """Seconds of all other functions."""


def run_trial(process: MethodProcess, subject: Subject, trial: Trial) -> Answers:
    """Ask a fresh copy of the method everything that the task scores.

    Raises:
        MethodError: it raises, or answers with something that cannot be scored.
    """
    where = trial.where
    names = [f"{name} of {where}" for name in subject.names]
    shapes = [(len(action.time), action.size) for action in subject.actions]
    mean = std = column_mean = pose = readings_std = None
    with process.trial(subject.view, [subject.pool[i] for i in trial.support if not trial.offered], where) as asked:
        asked.adapt()
        if trial.offered:
            trial = replace(trial, support=_choose(asked, subject, trial))
        readings = asked.ask("predict", (subject.actions, names), shapes)
        _check_readings(readings, names)
        if "predict_std" in asked.offers:
            readings_std = asked.ask("predict_std", (subject.actions, names), shapes)
            _check_readings(readings_std, names)
            for given, name in zip(readings_std, names, strict=True):
                if (given < 0.0).any():
                    raise MethodError(f"predict_std for {name} is negative; a standard deviation is 0 or greater.")
        if "stiffness" in asked.offers and subject.asks_stiffness:
            mean, std = _stiffness(asked, subject.points, where)
            if (mean < 0).any():
                raise MethodError(f"stiffness for {where} must be a non-negative mean a point; its smallest is "
                                  f"{mean.min()}.")
        if "stiffness" in asked.offers and subject.columns is not None:
            column_mean, _ = _stiffness(asked, subject.columns, where)
        if "locate" in asked.offers and subject.hidden is not None:
            pose = _pose(asked, subject.hidden, where)
    return Answers(trial, readings, readings_std, mean, std, column_mean, pose, asked.adapt_s, asked.predict_s)


def _choose(asked: Asked, subject: Subject, trial: Trial) -> tuple[int, ...]:
    """Make as many touches as the support has, each as the method chooses it; the drawn ones if it does not choose.

    Returns:
        Their indices, in order.
    """
    if "choose" not in asked.offers:
        for index in trial.support:
            asked.made(subject.pool[index])
        asked.adapt()
        return trial.support
    left, made = list(trial.offered), []
    for _ in trial.support:
        (answer,) = asked.ask("choose", [subject.plans[k] for k in left], [(1,)])
        made.append(left.pop(checked_choice(int(answer[0]) if np.isfinite(answer[0]) else None, len(left))))
        asked.made(subject.pool[made[-1]])
        asked.adapt()
    return tuple(made)


def _check_readings(readings: Iterable[np.ndarray], names: Iterable[str]) -> None:
    # The method's process has checked them with a better message; it may have been tampered with.
    for given, name in zip(readings, names, strict=True):
        if not np.isfinite(given).all() or np.abs(given).max(initial=0.0) > LARGEST_READING:
            raise MethodError(f"prediction for {name} is not finite, or over {LARGEST_READING:g}.")


def _stiffness(asked: Asked, points: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean (k,) and std (k,) of the method's stiffness at ``points`` (k, 3) [m]; no std where it gives none."""
    arrays = asked.ask("stiffness", points, None)
    if len(arrays) != 2:
        raise MethodError(f"stiffness for {where} was not answered with a mean and a std.")
    mean, std = arrays
    if mean.shape != (len(points),) or not np.isfinite(mean).all():
        raise MethodError(f"stiffness for {where} must be a finite mean a point, ({len(points)},); it has shape "
                          f"{mean.shape}.")
    if np.abs(mean).max(initial=0.0) > 1e100:
        raise MethodError(f"stiffness for {where} has a mean of {np.abs(mean).max():g}; its logarithm is scored, and "
                          f"it must be at most 1e100.")
    given = std.shape == mean.shape and bool(np.isfinite(std).all()) and bool((np.abs(std) <= 1e100).all())
    return mean, std if given else None


def _pose(asked: Asked, hidden: tuple[np.ndarray, np.ndarray], where: str) -> np.ndarray:
    arrays = asked.ask("locate", hidden, None)
    pose = arrays[0] if len(arrays) == 1 else np.zeros(0)
    if (pose.shape != (4, 4) or not np.isfinite(pose).all() or np.abs(pose).max() > 1e6
        or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)):
        raise MethodError(f"locate for {where} must be a rigid object-to-world transform (4, 4); it is "
                          f"{pose.tolist() if pose.size < 20 else pose.shape}.")
    return pose


_OPTIONAL = ("mean", "std", "column_mean", "pose")


def save(path: Path, answers: Iterable[Answers]) -> None:
    """Keep the answers of one seed; the file appears whole or not at all."""
    arrays: dict[str, np.ndarray] = {}
    heads = []
    for index, one in enumerate(answers):
        trial = one.trial
        heads.append([trial.subject, trial.shot, trial.seed, list(trial.support), one.adapt_s, one.predict_s,
                      len(one.readings)])
        for k, reading in enumerate(one.readings):
            arrays[f"{index}/readings/{k}"] = reading
        for k, std in enumerate(one.readings_std or ()):
            arrays[f"{index}/readings_std/{k}"] = std
        for name in _OPTIONAL:
            value = getattr(one, name)
            if value is not None:
                arrays[f"{index}/{name}"] = value
    arrays["heads"] = np.frombuffer(json.dumps(heads).encode(), np.uint8)
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    write_atomic(path, out.getvalue(), error=MethodError)


def load(path: Path) -> list[Answers] | None:
    """The answers that `save` kept; None if the file is not whole."""
    try:
        with np.load(path, allow_pickle=False) as file:
            out = []
            for index, head in enumerate(from_json(file["heads"].tobytes())):
                subject, shot, seed, support, adapt_s, predict_s, count = head
                readings = tuple(file[f"{index}/readings/{k}"] for k in range(count))
                stds = tuple(file[f"{index}/readings_std/{k}"] for k in range(count)
                             if f"{index}/readings_std/{k}" in file)
                rest = {name: file[f"{index}/{name}"] if f"{index}/{name}" in file else None for name in _OPTIONAL}
                out.append(Answers(Trial(subject, shot, seed, tuple(support)), readings, stds or None,
                                   adapt_s=adapt_s, predict_s=predict_s, **rest))
            return out
    except (OSError, ValueError, KeyError, TypeError, BadZipFile, EOFError):
        return None
