"""Run a method through a task and score it. The same code for our baselines and for everybody else's method."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.bench.inclusions import Inclusions, Mask
from vsfsim.bench.method import (
    Action,
    build_method,
    checked_prediction,
    find_method,
    frozen_view,
    parameters_of,
)
from vsfsim.bench.metrics import Answer, Record, metrics_of
from vsfsim.bench.protocol import Draw, Recording, divide, record, specimen, support
from vsfsim.bench.reached_points import reached
from vsfsim.bench.reading_metrics import touch_errors, touch_uncertainty
from vsfsim.bench.result import QUERY_COLUMNS, READING_COLUMNS, Result, Score, machine, peak_memory_mib, versions
from vsfsim.bench.stiffness_metrics import FEWEST_POINTS, can_be_scored
from vsfsim.bench.task import ALL, Task
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.data.dataset import Dataset
from vsfsim.data.provenance import made_by
from vsfsim.data.records import ObjectView, View

Progress = Callable[[int, int, str], None]


def evaluate(name: str, task: Task, dataset: Dataset, *, parameters: Mapping[str, Any] | None = None,
             seeds: int | None = None, progress: Progress | None = None) -> Result:
    """Score a method.

    Args:
        name: an installed method, or module:attribute.
        task: the task.
        dataset: as `open_dataset` returns it.
        parameters: of the method's constructor, over its defaults.
        seeds: draws of the support set, or None for the task's own number.
        progress: called with (adaptations done, of how many, what is going on).

    Raises:
        MethodError: the method is unknown, raises, or answers with something that cannot be scored.
        TaskError: the dataset has too few touches.
    """
    factory = find_method(name)
    values = parameters_of(factory, parameters or {})
    run = _Run(factory, values, task, dataset, tuple(range(task.protocol.seeds if seeds is None else seeds)),
               progress or (lambda *_: None))
    run.run()
    notes = [f"superseded by {task.superseded_by}"] if task.superseded_by else []
    if len(run.seeds) != task.protocol.seeds:
        notes.append(f"{len(run.seeds)} seeds instead of the task's {task.protocol.seeds}")
    return Result(
        task=task.name, task_sha256=task.sha256, dataset_sha256=dataset.sha256, dataset_made_by=dict(dataset.made_by),
        method=name, entry=f"{factory.__module__}:{getattr(factory, '__qualname__', factory)}", parameters=values,
        observation=task.observation.name, unit=task.observation.unit, shots=task.protocol.labels, seeds=run.seeds,
        scores=run.scores(), queries=run.columns(), timing=dict(run.timing),
        peak_memory_mib=round(peak_memory_mib(), 1), machine=machine(), made_by=made_by(), versions=versions(),
        notes=tuple(notes), readings=run.readings)


@dataclass(frozen=True)
class _Subject:
    """A test object."""
    record: ObjectView
    """With its truth, which only the harness sees."""
    view: View
    """What the method sees."""
    recording: Recording
    """All of its touches as the task shows them."""
    draw: Draw
    """Which touches are queries."""
    reached: np.ndarray
    """The probe points of the truth that some touch reached (P,) bool."""
    mask: Mask | None
    """Where the task ranks by a metric of the mask."""
    inclusions: Inclusions | None
    """Where the task ranks by a metric of the pose."""


@dataclass
class _Run:
    factory: type
    parameters: Mapping[str, Any]
    task: Task
    dataset: Dataset
    seeds: tuple[int, ...]
    progress: Progress
    records: dict[Answer, list[dict[str, Any]]] = field(default_factory=lambda: {answer: [] for answer in Answer})
    """The answers so far, each record with its ``object``, ``shot`` and ``seed``."""
    readings: dict[str, list] = field(default_factory=dict)
    """As `Result.readings`."""
    timing: dict[str, float] = field(default_factory=lambda: {
        "meta_fit_s": 0.0, "adapt_s": 0.0, "predict_s": 0.0, "adapts": 0, "predicts": 0})
    """As `Result.timing`."""

    def run(self) -> None:
        subjects = [self._subject(name) for name in self.dataset.names(self.task.protocol.test)]
        self.readings = readings_of([(subject.recording, subject.draw.query) for subject in subjects])
        blind = self.dataset.blind()
        specimens = [specimen(blind.load(name), self.task) for name in self.dataset.names(self.task.protocol.train)]
        # A method without a `seed` must be deterministic (`vsfsim check` tests it), so a support set that is the same
        # for every seed needs only one adaptation.
        seeded = "seed" in inspect.signature(self.factory).parameters
        labels = self.task.protocol.labels
        once = () if seeded else tuple(label for label in labels if label in ("0", ALL))
        total = len(subjects) * sum(1 if label in once else len(self.seeds) for label in labels)
        done, method = 0, None
        for seed in self.seeds:
            if method is None or seeded:
                self.progress(done, total, "meta-fit")
                method = build_method(self.factory, {**self.parameters, "seed": seed} if seeded else self.parameters)
                with self.timed("meta_fit_s", f"meta_fit on {len(specimens)} objects"):
                    method.meta_fit(specimens)
            for subject in subjects:
                for label in labels:
                    if label in once and seed != self.seeds[0]:
                        self._repeat(subject, label, seed)
                        continue
                    self.progress(done, total, f"{subject.record.name}, {label}-shot, seed {seed}")
                    _Trial(self, method, subject, label, seed).run()
                    done += 1
        self.progress(total, total, "done")

    def _subject(self, name: str) -> _Subject:
        view = self.dataset.load(name)
        assert view.truth is not None
        points = view.truth.probe_points
        near = np.zeros(len(points), bool)
        for touch in view.touches:
            near |= reached(points, view.probe, touch.mount_pose, q=touch.q)
        near &= view.truth.probe_stiffness > 0.0  # ratios are scored; a cone that met nothing has none
        ranked = self.task.metric.answer
        inclusions = Inclusions.of(self.dataset.recipe, view) if ranked in (Answer.MASK, Answer.POSE) else None
        mask = Mask.of(inclusions, view) if inclusions is not None and ranked is Answer.MASK else None
        return _Subject(view, frozen_view(view.view), record(view, self.task), divide(view, self.task.protocol), near,
                        mask, inclusions if ranked is Answer.POSE else None)

    def _repeat(self, subject: _Subject, label: str, seed: int) -> None:
        """Take the records of the first seed for ``seed`` as well."""
        first = (subject.record.name, label, self.seeds[0])
        for records in self.records.values():
            records += [{**row, "seed": seed} for row in records if (row["object"], row["shot"], row["seed"]) == first]

    @contextmanager
    def timed(self, key: str, what: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        except VsfsimError:
            raise
        except Exception as error:
            raise MethodError(f"the method raised {type(error).__name__} in {what}: {error}. --debug "
                              f"shows where.") from error
        finally:
            self.timing[key] += time.perf_counter() - start

    def scores(self) -> dict[str, dict[str, Score]]:
        labels = self.task.protocol.labels
        return {metric: by_shot for answer in Answer
                for metric, by_shot in scores_of(answer, self.records[answer], labels, self.seeds).items()}

    def columns(self) -> dict[str, list]:
        return {name: [row[name] for row in self.records[Answer.READINGS]] for name in QUERY_COLUMNS}


@dataclass
class _Trial:
    """One adaptation of a method, and every answer that is scored after it."""
    of: _Run
    method: Any
    """A `Method`; the optional functions are looked for by name."""
    subject: _Subject
    label: str
    seed: int

    @property
    def where(self) -> str:
        """For messages."""
        return f"{self.subject.record.name}, {self.label}-shot, seed {self.seed}"

    def run(self) -> None:
        recording, draw = self.subject.recording, self.subject.draw
        chosen = support(self.subject.record, draw, self.label, self.seed, self.of.task.protocol)
        with self.of.timed("adapt_s", f"adapt to {self.where}"):
            self.method.adapt(self.subject.view, [recording.readings[i] for i in chosen])
        self.of.timing["adapts"] += 1
        self._readings([recording.readings[i].action for i in draw.query])
        if np.count_nonzero(self.subject.reached) >= FEWEST_POINTS and hasattr(self.method, "stiffness"):
            self._stiffness(self.subject.record.truth)
        if self.subject.mask is not None and hasattr(self.method, "stiffness"):
            self._mask(self.subject.mask)
        if self.subject.inclusions is not None and hasattr(self.method, "locate"):
            self._pose(self.subject.inclusions)

    def _keep(self, answer: Answer, **record: Any) -> None:
        self.of.records[answer].append({"object": self.subject.record.name, "shot": self.label, "seed": self.seed,
                                        **record})

    def _readings(self, actions: list[Action]) -> None:
        query, recording = self.subject.draw.query, self.subject.recording
        names = [f"touch {i} of {self.where}" for i in query]
        with self.of.timed("predict_s", f"predict for {self.where}"):
            given = self.method.predict(actions)
        self.of.timing["predicts"] += len(actions)
        predictions = checked_prediction(given, actions, names)
        for index, prediction in zip(query, predictions, strict=True):
            valid = recording.readings[index].valid
            self._keep(Answer.READINGS, touch=index, **touch_errors(prediction, recording.clean[index], valid))
        if not hasattr(self.method, "predict_std"):
            return
        with self.of.timed("predict_s", f"predict_std for {self.where}"):
            given = self.method.predict_std(actions)
        for index, prediction, std in zip(query, predictions, checked_prediction(given, actions, names), strict=True):
            if (std < 0.0).any():
                raise MethodError(f"predict_std for touch {index} of {self.where} is negative; a standard deviation is "
                                  f"0 or greater.")
            valid = recording.readings[index].valid
            self._keep(Answer.READING_STD, touch=index,
                       **touch_uncertainty(prediction, std, recording.clean[index], valid))

    def _stiffness(self, truth: Any) -> None:
        points, known = truth.probe_points[self.subject.reached], truth.probe_stiffness[self.subject.reached]
        mean, std = self._estimate(points)
        if (mean < 0).any():
            raise MethodError(f"stiffness for {self.where} must be a non-negative mean a point; its smallest is "
                              f"{mean.min()}.")
        if can_be_scored(mean, known):
            given = std.shape == mean.shape and bool(np.isfinite(std).all())
            self._keep(Answer.STIFFNESS, mean=mean, std=std if given else None, truth=known)

    def _mask(self, mask: Mask) -> None:
        mean, _ = self._estimate(mask.points)
        self._keep(Answer.MASK, value=mask.pixel_values(mean), stiff=mask.stiff)

    def _pose(self, inclusions: Inclusions) -> None:
        vertices, triangles, truth = inclusions.known_object()
        with self.of.timed("predict_s", f"locate for {self.where}"):
            pose = np.asarray(self.method.locate(vertices, triangles), float)
        if (pose.shape != (4, 4) or not np.isfinite(pose).all()
            or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6)):
            raise MethodError(f"locate for {self.where} must be a rigid object-to-world transform (4, 4); it is "
                              f"{pose.tolist()}.")
        self._keep(Answer.POSE, estimate=pose, truth=truth)

    def _estimate(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and std of the method's stiffness at ``points`` (k, 3) [m]."""
        with self.of.timed("predict_s", f"stiffness for {self.where}"):
            given = self.method.stiffness(points)
        mean, std = np.asarray(given.mean, float), np.asarray(given.std, float)
        if mean.shape != (len(points),) or not np.isfinite(mean).all():
            raise MethodError(f"stiffness for {self.where} must be a finite mean a point, ({len(points)},); it has "
                              f"shape {mean.shape}.")
        return mean, std


def readings_of(asked: Iterable[tuple[Recording, Iterable[int]]]) -> dict[str, list]:
    """`Result.readings` of recordings and their query touches."""
    rows = [(recording.name, index, recording.clean[index][recording.readings[index].valid])
            for recording, query in asked for index in query]
    columns = ([name for name, _, _ in rows], [int(index) for _, index, _ in rows], [int(v.size) for _, _, v in rows],
               [float(np.sum(v**2)) for _, _, v in rows])
    return dict(zip(READING_COLUMNS, columns, strict=True))


def scores_of(answer: Answer, records: Sequence[Record], labels: tuple[str, ...],
              seeds: tuple[int, ...]) -> dict[str, dict[str, Score]]:
    """The metrics of one kind of answer, by metric and shot.

    A shot at which some seed has no record is left out, and so is a metric that a record lacks something for.

    Args:
        answer: what was asked. records: with ``shot`` and ``seed`` besides; those of the readings are the rows of
        `Result.queries`. labels, seeds: of the result.
    """
    out: dict[str, dict[str, Score]] = {}
    for label in labels:
        parts = [[row for row in records if row["shot"] == label and row["seed"] == seed] for seed in seeds]
        for metric in metrics_of(answer) if all(parts) else ():
            values = [metric.score(part) for part in parts]
            known = [value for value in values if value is not None]
            if len(known) == len(values):
                out.setdefault(metric.name, {})[label] = Score.of(known)
    return out
