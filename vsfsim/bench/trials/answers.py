"""Test objects as a method meets them, and what it answered, checked by the scorer and kept until all trials are done.

A method meets everything that is asked, without the truth and without a reading of a query. Each object view is read
from its file once for all trainings of an evaluation.
"""

from __future__ import annotations

import threading
import zlib
from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.isolation.process import Learned, MethodHost, Process
from vsfsim.bench.isolation.wire import decoded, encoded
from vsfsim.bench.method import Reading, Specimen, checked_choice, checked_prediction
from vsfsim.bench.protocol import Answers, Subject, Trial, record, specimen_of, support
from vsfsim.bench.task import Protocol, Task
from vsfsim.core.errors import MethodError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic


def asked_of(subject: Subject, label: str, run: int, protocol: Protocol) -> Trial:
    """The trial of a test object at shot ``label`` in a run."""
    draw, pool = protocol.draw_of(run), subject.draw.pool
    given = support(subject, subject.draw, label, draw, protocol)
    choice = protocol.support == "chosen" and 0 < len(given) < len(pool)
    return Trial(subject.name, label, run, given,
                 support(subject, subject.draw, str(len(pool)), draw, protocol) if choice else ())


class Reader:
    """Reads the object views that methods learn from and are asked about, without their truth but for the places of the
    probed points.

    A view of 60 touches takes a second to read, and every fold learns from most of the others' views. All trainings of
    an evaluation share a reader.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._specimens: dict[tuple[Hashable, ...], Specimen] = {}
        self._subjects: dict[tuple[Hashable, ...], Subject] = {}

    def specimen(self, task: Task, dataset: Dataset, name: str) -> Specimen:
        """A training object as a method receives it.

        Args:
            task: whose noise and observation its readings have. dataset: where it is. name: of the object view.

        Raises:
            TaskError: it does not hold what the task reads.
        """
        key = _readings(task, dataset, name)
        with self._lock:
            if key not in self._specimens:
                view = dataset.blind().load(name)
                self._specimens[key] = specimen_of(view, record(view, task))
            return self._specimens[key]

    def subject(self, task: Task, dataset: Dataset, name: str) -> Subject:
        """A test object as a method meets it.

        Args:
            task: whose protocol it is asked by. dataset: where it is. name: of the object view.

        Raises:
            TaskError: it has too few touches, or not what the task reads.
        """
        readings = _readings(task, dataset, name)
        key = (*readings, task.protocol, task.primary)  # a study asks a task by a protocol of its own
        with self._lock:
            if key not in self._subjects:
                view, places = dataset.shown(name)
                self._subjects[key] = Subject.of(view, places, task, dataset)
                self._specimens.setdefault(readings, specimen_of(view, self._subjects[key].recording))
            return self._subjects[key]


def _readings(task: Task, dataset: Dataset, name: str) -> tuple[Hashable, ...]:
    """What decides how the touches of an object view read, and which of them are learned from."""
    return dataset.path, name, task.observation.name, task.noise, task.protocol.transfer


@dataclass(frozen=True)
class Done:
    """What came of one training and its trials."""

    answers: tuple[Answers, ...]
    """Of its trials."""
    meta_fit_s: float
    """Seconds of `meta_fit`."""
    peak_memory_mib: float
    """Largest resident size of the method's processes [MiB]."""
    opened: tuple[str, ...]
    """Files that the method opened besides its source."""


def run_trial(host: MethodHost, learned: Learned, subject: Subject, trial: Trial) -> Answers:
    """Ask a fresh copy of the method that learned everything that the task scores.

    Raises:
        MethodError: it raises, or answers with something that cannot be scored.
    """
    where = trial.where
    names, actions = [f"touch {i} of {where}" for i in subject.draw.query], subject.actions
    mean = column_mean = pose = None
    support = [subject.recording.readings[i] for i in trial.support if not trial.offered]
    with host.trial(learned) as process:
        offers = _adapt(process, subject, support, where)
        if trial.offered:
            trial = replace(trial, support=_choose(process, subject, trial, "choose" in offers))
        reply = process.ask("predict", (actions, names), f"predict for {where}")
        # the process has checked it, but may have been tampered with
        readings = tuple(checked_prediction(reply.arrays, actions, names))
        if "stiffness" in offers and subject.asks_stiffness:
            mean = _stiffness(process, subject.points, where)
            if (mean < 0).any():
                raise MethodError(f"stiffness for {where} must be a non-negative mean a point; its smallest is "
                                  f"{mean.min()}.")
        if "stiffness" in offers and subject.columns is not None:
            column_mean = _stiffness(process, subject.columns.points, where)
        if "locate" in offers and subject.columns is None and subject.inclusions is not None:
            pose = _pose(process, subject.inclusions.known_object()[:2], where)
    took = process.seconds
    return Answers(trial, readings, mean, column_mean, pose, took["adapt"],
                   sum(took[name] for name in ("choose", "predict", "stiffness", "locate")))


def _adapt(process: Process, subject: Subject, support: list[Reading], where: str) -> list[str]:
    """Adapt to the view and a support set; the optional functions that the method has."""
    offers = process.ask("adapt", (subject.view, support), f"adapt to {where}").head.get("offers")
    return offers if isinstance(offers, list) else []


def _choose(process: Process, subject: Subject, trial: Trial, chooses: bool) -> tuple[int, ...]:
    """Make as many touches as the support has, each as the method chooses it; the drawn ones if it does not choose.

    Returns:
        Their indices, in order.
    """
    left, made, known = list(trial.offered), list[int](), subject.recording
    for index in trial.support:
        if chooses:
            so_far, offered = [known.readings[k] for k in made], [known.queries[k].action for k in left]
            answer = process.ask("choose", (subject.view, so_far, offered), f"choose for {trial.where}").head
            index = left.pop(checked_choice(answer.get("chosen"), len(left)))
        made.append(index)
        if chooses or len(made) == len(trial.support):
            _adapt(process, subject, [known.readings[k] for k in made], trial.where)
    return tuple(made)


def _stiffness(process: Process, points: np.ndarray, where: str) -> np.ndarray:
    """Mean (k,) of the method's stiffness at ``points`` (k, 3) [m]."""
    arrays = process.ask("stiffness", points, f"stiffness for {where}").arrays
    mean = arrays[0] if len(arrays) == 1 else np.zeros(0)
    if mean.shape != (len(points),) or not np.isfinite(mean).all():
        raise MethodError(f"stiffness for {where} must be a finite mean a point, ({len(points)},); it has shape "
                          f"{mean.shape}.")
    if np.abs(mean).max(initial=0.0) > 1e100:
        raise MethodError(f"stiffness for {where} has a mean of {np.abs(mean).max():g}; its logarithm is scored, and "
                          f"it must be at most 1e100.")
    return mean


def _pose(process: Process, hidden: tuple[np.ndarray, np.ndarray], where: str) -> np.ndarray:
    arrays = process.ask("locate", hidden, f"locate for {where}").arrays
    pose = arrays[0] if len(arrays) == 1 else np.zeros(0)
    if (pose.shape != (4, 4) or not np.isfinite(pose).all() or np.abs(pose).max() > 1e6
        or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)):
        raise MethodError(f"locate for {where} must be a rigid object-to-world transform (4, 4); it is "
                          f"{pose.tolist() if pose.size < 20 else pose.shape}.")
    return pose


def save(path: Path, value: Any) -> None:
    """Keep what came of a training, or another record with arrays; the file appears whole or not at all.

    Raises:
        MethodError: it cannot be written.
    """
    write_atomic(path, zlib.compress(encoded(value)), error=MethodError)


def load(path: Path, kind: Any = Done) -> Any:
    """What `save` kept, of the type ``kind``; None if the file is not whole."""
    try:
        return decoded(zlib.decompress(path.read_bytes()), kind)
    except (OSError, zlib.error, ValueError):
        return None
