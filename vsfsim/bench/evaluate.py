"""Run a method through a task and score it. The same code for our baselines and for everybody else's method."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.bench.hidden import MASK_METRICS, POSE_METRICS, Hidden, Mask, pose_scores
from vsfsim.bench.method import (
    Action,
    Method,
    build_method,
    checked_prediction,
    find_method,
    frozen_view,
    parameters_of,
)
from vsfsim.bench.metrics import READING_METRICS, STIFFNESS_METRICS, reading_scores, stiffness_scores, touch_errors
from vsfsim.bench.protocol import Draw, Recording, divide, record, specimen, support
from vsfsim.bench.reached import reached
from vsfsim.bench.result import QUERY_COLUMNS, READING_COLUMNS, Result, Score, machine, peak_memory_mib, versions
from vsfsim.bench.task import ALL, Task
from vsfsim.bench.uncertainty import (
    STIFFNESS_UNCERTAINTY,
    reading_uncertainty,
    stiffness_uncertainty,
    touch_uncertainty,
)
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
        task: what is asked. dataset: as `open_dataset` gives it.
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
    run.all()
    notes = [f"superseded by {task.superseded_by}"] if task.superseded_by else []
    if len(run.seeds) != task.protocol.seeds:
        notes.append(f"{len(run.seeds)} seeds instead of the task's {task.protocol.seeds}")
    return Result(
        task=task.name, task_sha256=task.sha256, dataset_sha256=dataset.sha256, dataset_made_by=dict(dataset.made_by),
                  method=name,
        entry=f"{factory.__module__}:{getattr(factory, '__qualname__', factory)}", parameters=values,
                  observation=task.observation.name,
        unit=task.observation.unit, shots=task.protocol.labels, seeds=run.seeds, scores=run.scores(),
                  queries=run.columns(),
        timing=dict(run.timing), peak_memory_mib=round(peak_memory_mib(), 1), machine=machine(), made_by=made_by(),
                  versions=versions(), notes=tuple(notes),
        readings=run.readings)


@dataclass(frozen=True)
class _Subject:
    """A test object: the record with its truth, which only the ruler sees, and what the method sees."""

    record: ObjectView
    view: View
    recording: Recording
    draw: Draw
    reached: np.ndarray  # probe points of the truth that some touch reached
    mask: Mask | None  # where the task seeks one
    known: tuple[np.ndarray, np.ndarray, np.ndarray] | None  # vertices, triangles and pose of the object that it seeks


@dataclass
class _Run:
    factory: type
    parameters: Mapping[str, Any]
    task: Task
    dataset: Dataset
    seeds: tuple[int, ...]
    progress: Progress
    rows: list[dict[str, Any]] = field(default_factory=list)
    stiffness: dict[tuple[str, int], list[dict[str, float]]] = field(default_factory=dict)
    # of readings, one row a query touch
    spread: dict[tuple[str, int], list[dict[str, float]]] = field(default_factory=dict)
    readings: dict[str, list] = field(default_factory=dict)  # as `Result.readings`
    # scores of the mask or the pose, one row an object
    hidden: dict[tuple[str, int], list[dict[str, Any]]] = field(default_factory=dict)
    timing: dict[str, float] = field(default_factory=lambda: {"meta_fit_s": 0.0, "adapt_s": 0.0, "predict_s": 0.0,
                                                              "adapts": 0, "predicts": 0})

    def all(self) -> None:
        subjects = [self._subject(name) for name in self.dataset.names(self.task.protocol.test)]
        self.readings = readings_of([(subject.recording, subject.draw.query) for subject in subjects])
        specimens = [specimen(view, self.task) for view in map(self.dataset.blind().load,
                                                               self.dataset.names(self.task.protocol.train))]
        # A method without a `seed` must be deterministic (`vsfsim check` proves it), so a support set that is the same
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
                with self._timed("meta_fit_s", f"meta_fit on {len(specimens)} objects"):
                    method.meta_fit(specimens)
            for subject in subjects:
                for label in labels:
                    if label in once and seed != self.seeds[0]:
                        self._repeat(subject, label, seed)
                        continue
                    self.progress(done, total, f"{subject.record.name}, {label}-shot, seed {seed}")
                    self._trial(method, subject, label, seed)
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
        hidden = Hidden.of(self.dataset.recipe, view) if self.task.seeks else None
        mask = Mask.of(hidden, view) if hidden is not None and self.task.seeks == "mask" else None
        known = hidden.known_object() if hidden is not None and self.task.seeks == "pose" else None
        return _Subject(view, frozen_view(view.view), record(view, self.task), divide(view, self.task.protocol), near,
                        mask, known)

    def _trial(self, method: Method, subject: _Subject, label: str, seed: int) -> None:
        chosen = support(subject.record, subject.draw, label, seed, self.task.protocol)
        where = f"{subject.record.name}, {label}-shot, seed {seed}"
        with self._timed("adapt_s", f"adapt to {where}"):
            method.adapt(subject.view, [subject.recording.readings[i] for i in chosen])
        actions = [subject.recording.readings[i].action for i in subject.draw.query]
        with self._timed("predict_s", f"predict for {where}"):
            answer = method.predict(actions)
        self.timing["adapts"] += 1
        self.timing["predicts"] += len(actions)
        names = [f"touch {i} of {where}" for i in subject.draw.query]
        answer = checked_prediction(answer, actions, names)
        self._spread(method, subject, label, seed, actions, answer, names)
        for index, prediction in zip(subject.draw.query, answer):
            errors = touch_errors(prediction, subject.recording.clean[index], subject.recording.readings[index].valid)
            self.rows.append({"object": subject.record.name, "shot": label, "seed": seed, "touch": index, **errors})
        self._stiffness(method, subject, label, seed, where)
        self._hidden(method, subject, label, seed, where)

    def _hidden(self, method: Method, subject: _Subject, label: str, seed: int, where: str) -> None:
        if subject.mask is not None and hasattr(method, "stiffness"):
            points = subject.mask.points
            with self._timed("predict_s", f"stiffness for {where}"):
                stiffness = np.asarray(method.stiffness(points).mean, float)
            if stiffness.shape != (len(points),) or not np.isfinite(stiffness).all():
                raise MethodError(f"stiffness for {where} must be a finite mean a point, ({len(points)},); it has "
                                  f"shape {stiffness.shape}.")
            scores = subject.mask.scores(stiffness)
        elif subject.known is not None and hasattr(method, "locate"):
            vertices, triangles, truth = subject.known
            with self._timed("predict_s", f"locate for {where}"):
                pose = np.asarray(method.locate(vertices.copy(), triangles.copy()), float)
            if pose.shape != (4,
                              4) or not np.isfinite(pose).all() or not np.allclose(pose[:3, :3] @ pose[:3, :3].T,
                                                                                   np.eye(3), atol=1e-6):
                raise MethodError(f"locate for {where} must be a rigid object-to-world transform (4, 4); it is "
                                  f"{pose.tolist()}.")
            scores = pose_scores(pose, truth)
        else:
            return
        self.hidden.setdefault((label, seed), []).append({"object": subject.record.name, **scores})

    def _spread(self, method: Method, subject: _Subject, label: str, seed: int, actions: list[Action],
                answer: list[np.ndarray], names: list[str]) -> None:
        if not hasattr(method, "predict_std"):
            return
        with self._timed("predict_s", f"predict_std for {names[0]}"):
            spread = method.predict_std(actions)
        for index, prediction, std in zip(subject.draw.query, answer, checked_prediction(spread, actions, names)):
            if (std < 0.0).any():
                raise MethodError(f"predict_std for touch {index} of {subject.record.name} is negative; a standard "
                                  f"deviation is 0 or greater.")
            row = touch_uncertainty(prediction, std, subject.recording.clean[index],
                                    subject.recording.readings[index].valid)
            self.spread.setdefault((label, seed), []).append({"object": subject.record.name, **row})

    def _stiffness(self, method: Method, subject: _Subject, label: str, seed: int, where: str) -> None:
        if not hasattr(method, "stiffness") or np.count_nonzero(subject.reached) < 3:
            return
        truth = subject.record.truth
        assert truth is not None
        with self._timed("predict_s", f"stiffness for {where}"):
            given = method.stiffness(truth.probe_points[subject.reached])
        estimate, std = np.asarray(given.mean, float), np.asarray(given.std, float)
        if estimate.shape != (int(subject.reached.sum()),) or not np.isfinite(estimate).all() or (estimate < 0).any():
            raise MethodError(f"stiffness for {where} must be a finite, non-negative mean a point, "
                              f"({int(subject.reached.sum())},); it has shape {estimate.shape}.")
        scores = stiffness_scores(estimate, truth.probe_stiffness[subject.reached])
        if scores is not None:
            sure = stiffness_uncertainty(estimate, std,
                                         truth.probe_stiffness[subject.reached]) if std.shape == estimate.shape and np.isfinite(std).all() else None
            self.stiffness.setdefault((label, seed), []).append({**scores, **(sure or {})})

    def _repeat(self, subject: _Subject, label: str, seed: int) -> None:
        first = self.seeds[0]
        self.rows += [{**row, "seed": seed} for row in self.rows
                      if row["object"] == subject.record.name and row["shot"] == label and row["seed"] == first]
        if (label, first) in self.stiffness:
            self.stiffness[label, seed] = self.stiffness[label, first]
        for table in (self.spread, self.hidden):
            mine = [row for row in table.get((label, first), []) if row["object"] == subject.record.name]
            if mine:
                table.setdefault((label, seed), []).extend(mine)

    @contextmanager
    def _timed(self, key: str, what: str) -> Iterator[None]:
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
        return {**scores_of(self.rows, self.task.protocol.labels, self.seeds), **self._spread_scores(),
                **self._stiffness_scores(), **self._hidden_scores()}

    def _hidden_scores(self) -> dict[str, dict[str, Score]]:
        out: dict[str, dict[str, Score]] = {}
        for label in self.task.protocol.labels if self.hidden else ():
            for metric in MASK_METRICS if self.task.seeks == "mask" else POSE_METRICS:
                out.setdefault(metric,
                               {})[label] = Score.of([float(np.mean([row[metric] for row in self.hidden[label, seed]]))
                                                      for seed in self.seeds])
        return out

    def _spread_scores(self) -> dict[str, dict[str, Score]]:
        out: dict[str, dict[str, Score]] = {}
        for label in self.task.protocol.labels if self.spread else ():
            seeds = [reading_uncertainty(self.spread[label, seed]) for seed in self.seeds]
            for metric in seeds[0]:
                out.setdefault(metric, {})[label] = Score.of([scores[metric] for scores in seeds])
        return out

    def _stiffness_scores(self) -> dict[str, dict[str, Score]]:
        out: dict[str, dict[str, Score]] = {}
        for label in self.task.protocol.labels:
            parts = [self.stiffness.get((label, seed), []) for seed in self.seeds]
            if all(parts):
                # An object without a std (or an estimate that is 0 everywhere) takes a metric from the whole row.
                for metric in (m for m in (*STIFFNESS_METRICS, *STIFFNESS_UNCERTAINTY)
                               if all(m in part for parts_ in parts for part in parts_)):
                    out.setdefault(metric, {})[label] = Score.of([float(np.mean([part[metric] for part in seed_parts]))
                                                                  for seed_parts in parts])
        return out

    def columns(self) -> dict[str, list]:
        return {name: [row[name] for row in self.rows] for name in QUERY_COLUMNS}


def readings_of(asked: Iterable[tuple[Recording, Iterable[int]]]) -> dict[str, list]:
    """`Result.readings` of recordings and their query touches."""
    rows = [(recording.name, index, recording.clean[index][recording.readings[index].valid]) for recording,
            query in asked for index in query]
    columns = ([name for name, _, _ in rows], [int(index) for _, index, _ in rows], [int(v.size) for _, _, v in rows],
               [float(np.sum(v**2)) for _, _, v in rows])
    return dict(zip(READING_COLUMNS, columns, strict=True))


def scores_of(rows: list[dict[str, Any]], labels: tuple[str, ...],
              seeds: tuple[int, ...]) -> dict[str, dict[str, Score]]:
    """The reading metrics by metric and shot, from the raw rows of `Result.queries`."""
    out: dict[str, dict[str, Score]] = {metric: {} for metric in READING_METRICS}
    for label in labels:
        per_seed = [reading_scores([row for row in rows if row["shot"] == label and row["seed"] == seed])
                    for seed in seeds]
        for metric in READING_METRICS:
            out[metric][label] = Score.of([scores[metric] for scores in per_seed])
    return out
