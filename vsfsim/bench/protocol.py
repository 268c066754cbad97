"""Support and query touches and folds of objects: the draws of a task, and the readings behind them.

All draws come from `SeedSequence(protocol.seed, spawn_key=...)`: the query set of an object from (0, object, view), the
support order of a seed from (1, object, view, seed), the folds of cross-validation from (2,). A support set of k
touches is the first k of that order, so the 5 touches of a seed contain its 1 touch. Every object of a dataset is a
test object exactly once, and all views of an object are in the same fold.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any

import numpy as np

from vsfsim.bench.inclusions import Columns, Inclusions, reached_in
from vsfsim.bench.method import Action, Reading, Specimen, Surface, frozen, frozen_view
from vsfsim.bench.metrics import FEWEST_POINTS, Answer
from vsfsim.bench.noise import Noise, noisy_node_force, noisy_nodes, window
from vsfsim.bench.task import ALL, Protocol, Task
from vsfsim.core.chain import Chain
from vsfsim.core.errors import TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, Touch, View


@dataclass(frozen=True)
class Query:
    """A touch that a method predicts: its plan, and what was read in those frames of it that were made.

    The path that was taken is not shown where a plan is kept: an arm leaves its plan where the force limit is met, so
    that the end of the path tells the reading.
    """

    action: Action
    """The plan of T frames; the path that was taken where the dataset keeps no plan."""
    clean: np.ndarray
    """Noise-free readings (T, d) in the task's unit; NaN in frames that were not made."""
    scored: np.ndarray
    """Whether a frame was made as planned and converged (T,) bool."""


@dataclass(frozen=True)
class Recording:
    """All touches of one object view as the task shows them, with their noise-free readings."""

    name: str
    """Of the object view."""
    readings: tuple[Reading, ...]
    """Noisy, one a touch."""
    clean: tuple[np.ndarray, ...]
    """Noise-free, (T, d) in the task's unit, one a touch."""
    queries: tuple[Query, ...]
    """The same touches as a method is asked about them."""
    shown: tuple[bool, ...]
    """Which of them are learned from if the object is a training object."""


def record(view: ObjectView, task: Task) -> Recording:
    """Reduce the touches of ``view`` to readings, with the task's noise on them.

    Raises:
        TaskError: the dataset does not hold what the task reads.
    """
    row = task.observation
    readings, clean, queries = [], [], []
    _check_plan(view, task)
    for index, touch in enumerate(view.touches):
        which = {"object_index": view.object_index, "view_index": view.view_index, "touch_index": index}
        values = row.channel.clean(touch)
        if values is None:
            raise TaskError(f"object view '{view.name}' touch {index} has no {row.channel.name}, which task "
                            f"{task.name} reads; its dataset must be made with {row.channel.made_with}.")
        values, force = _where_converged(values, touch), _where_converged(touch.force, touch)
        noisy = row.channel.noisy(values, touch.time, force, task.noise, **which, **row.channel.motion(touch))
        action = Action(frozen(touch.time), frozen(touch.mount_pose), frozen(touch.axis), view.probe_of(touch),
                        row.name, row.size, None if touch.q is None else frozen(touch.q), touch.mount_stiffness)
        readings.append(Reading(action, frozen(row.reading(noisy, touch.axis)), frozen(touch.converged),
                                _surface(touch, task.noise, which)))
        clean.append(row.reading(values, touch.axis))
        queries.append(_query(touch, action, clean[-1], task.protocol))
    return Recording(view.name, tuple(readings), tuple(clean), tuple(queries),
                     tuple(bool(touch.converged.any()) and not (task.protocol.transfer and touch.press)
                           for touch in view.touches))


def _query(touch: Touch, action: Action, clean: np.ndarray, protocol: Protocol) -> Query:
    if touch.planned_pose is None or touch.planned_time is None or touch.planned_frame is None:
        return Query(action, clean, counted(touch, protocol))
    plan = replace(action, time=frozen(touch.planned_time), poses=frozen(touch.planned_pose),
                               q=None if touch.planned_q is None else frozen(touch.planned_q))
    made = np.flatnonzero(counted(touch, protocol))
    frame = touch.planned_frame[made]
    values, scored = np.full((len(plan.time), clean.shape[1]), np.nan), np.zeros(len(plan.time), bool)
    values[frame], scored[frame] = clean[made], True
    return Query(plan, values, scored)


def as_planned(touch: Touch) -> np.ndarray:
    """Which frames of a touch converged, and were made as planned (T,) bool."""
    return touch.converged if touch.planned_frame is None else touch.converged & (touch.planned_frame >= 0)


def counted(touch: Touch, protocol: Protocol) -> np.ndarray:
    """Which frames of a query touch are scored (T,) bool: those made as planned whose contact the mesh resolves, or all
    of them where the task says so or nothing is known of it."""
    made = as_planned(touch)
    return made if protocol.unresolved == "scored" or touch.resolved is None else made & touch.resolved


def share_unresolved(touches: Iterable[Touch]) -> tuple[int, int, float]:
    """Number of converged frames in contact, how many of them the mesh does not resolve, and their share of the squared
    force [-]."""
    frames = np.concatenate([np.zeros((0, 2)), *(np.stack([(t.force[t.converged] ** 2).sum(axis=1), (
        ~t.resolved if t.resolved is not None else np.zeros(len(t.time), bool))[t.converged]], axis=1)
        for t in touches)])
    size, odd = frames[frames[:, 0] > 0.0].T
    return len(size), int(odd.sum()), float(size @ odd / max(size.sum(), np.finfo(float).tiny))


def _check_plan(view: ObjectView, task: Task) -> None:
    """Refuse an arm's touches without their plan where the task needs it."""
    if task.protocol.folds and isinstance(view.probe, Chain) and any(t.planned_pose is None for t in view.touches):
        raise TaskError(f"object view '{view.name}' does not keep the planned paths of its touches, and task "
                        f"{task.name} asks for predictions of planned touches. Generate the dataset again from a scene "
                        f"with plan = true in [touches].")


def _where_converged(values: np.ndarray, touch: Touch) -> np.ndarray:
    """``values`` (T, ...), NaN in the frames that did not converge."""
    return np.where(touch.converged.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)


def _surface(touch: Touch, noise: Noise, which: Mapping[str, int]) -> Surface | None:
    """The sensor's surface with the noise of its inside camera; None where the dataset does not hold one."""
    if touch.node_position is None or touch.node_force is None or touch.node_rest is None:
        return None
    nodes, seen = touch.node_position, window(touch.node_rest, noise)
    if noise.depth_std or noise.depth_quantum or noise.image_lag or noise.tracking_std:
        nodes = noisy_nodes(nodes, touch.mount_pose, touch.time, noise, **which)
    force = noisy_node_force(_where_converged(touch.node_force, touch), touch.time, noise, **which)
    return Surface(frozen(nodes[:, seen]), frozen(force[:, seen]))


def specimen(view: ObjectView, task: Task) -> Specimen:
    """A training object as methods receive it: all touches that have a reading and, with ``transfer``, are the scene's
    own."""
    return specimen_of(view, record(view, task))


def specimen_of(view: ObjectView, recording: Recording) -> Specimen:
    """As `specimen`, of a view whose recording is known."""
    return Specimen(view.name, frozen_view(view.view), tuple(compress(recording.readings, recording.shown)))


@dataclass(frozen=True)
class Draw:
    """The fixed division of a test object's touches."""

    query: tuple[int, ...]
    """Indices of the touches that are predicted at every shot and seed, ascending."""
    pool: tuple[int, ...]
    """Indices of the other touches that have a reading, ascending."""


def divide(view: ObjectView, protocol: Protocol) -> Draw:
    """Choose the query touches of a test object.

    Raises:
        TaskError: there are too few touches with a reading for the query set and the largest support set.
    """
    usable = np.array([i for i, touch in enumerate(view.touches) if counted(touch, protocol).any()],
                      dtype=int)
    apart = protocol.transfer or protocol.stations > 1
    asked = np.array([i for i in usable if i % protocol.stations == protocol.stations - 1
                      and (view.touches[i].press or not protocol.transfer)], dtype=int)
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(0, view.object_index, view.view_index))
    query = np.random.default_rng(stream).permutation(asked)[:protocol.query]
    pool = np.setdiff1d(usable, asked if apart else query)
    if len(query) < protocol.query or len(pool) < max(protocol.shots):
        kinds = f", {len(asked)} of them of other kinds than the scene's own press" if protocol.transfer else (
            f", {len(asked)} of them the last of their branch" if apart else "")
        raise TaskError(f"object view '{view.name}' has {len(usable)} touches with a converged frame{kinds}; "
                        f"{protocol.query} query touches and {max(protocol.shots)} shots need "
                        f"{protocol.query + max(protocol.shots)}. Generate more touches, or lower query or shots in a "
                        f"task of your own.")
    return Draw(tuple(sorted(map(int, query))), tuple(map(int, pool)))


def support(view: Any, draw: Draw, label: str, seed: int, protocol: Protocol) -> tuple[int, ...]:
    """Indices of the support touches for shot ``label`` ("0", "5", "all") and draw ``seed``, in the order they are
    given; ``view`` has the numbers of an object view, object_index and view_index, which choose its random stream."""
    if label == ALL:
        return draw.pool
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(1, view.object_index, view.view_index, seed))
    order = np.random.default_rng(stream).permutation(np.array(draw.pool, dtype=int))
    return tuple(int(i) for i in order[:int(label)])


@dataclass(frozen=True)
class Subject:
    """A test object."""

    name: str
    """Of the object view."""
    object_index: int
    """From 0."""
    view_index: int
    """Of the view of that object, from 0."""
    view: View
    """What the method sees."""
    draw: Draw
    """Which touches are queries, and which may be given."""
    recording: Recording
    """Of all its touches."""
    near: np.ndarray
    """Which of the probed surface points some touch reached (P,) bool."""
    points: np.ndarray
    """Where these are, world (k, 3) [m]: there the stiffness is asked."""
    columns: Columns | None
    """Where the stiffness is asked for a mask; None where the task does not rank by one."""
    inclusions: Inclusions | None
    """Which are the mask, or without `columns` are to be located; None where the task ranks by neither."""

    @classmethod
    def of(cls, view: ObjectView, places: np.ndarray, task: Task, dataset: Dataset) -> Subject:
        """A test object.

        Args:
            view: of the object. places: of its probed points, world (P, 3) [m]. task: whose protocol it is asked by.
            dataset: where it is.

        Raises:
            TaskError: it has too few touches.
        """
        near, ranked = reached_in(view, places), task.metric.answer
        return cls(view.name, view.object_index, view.view_index, frozen_view(view.view), divide(view, task.protocol),
                   record(view, task), near, places[near], Columns.of(places, view) if ranked is Answer.MASK else None,
                   Inclusions.of(dataset.recipe, view) if ranked in (Answer.MASK, Answer.POSE) else None)

    @property
    def actions(self) -> tuple[Action, ...]:
        """Of the query touches."""
        return tuple(self.recording.queries[i].action for i in self.draw.query)

    @property
    def asks_stiffness(self) -> bool:
        """Whether enough points were reached."""
        return len(self.points) >= FEWEST_POINTS


@dataclass(frozen=True)
class Trial:
    """One adaptation that the task asks for."""

    subject: str
    """Name of the object view."""
    shot: str
    """Label of the shot."""
    seed: int
    """Of the support draw."""
    support: tuple[int, ...]
    """Indices of the support touches."""
    offered: tuple[int, ...] = ()
    """Indices of the touches that a method with `choose` takes its support from, in the drawn order; () where it is
    given ``support``."""

    @property
    def where(self) -> str:
        """For messages."""
        return f"{self.subject}, {self.shot}-shot, seed {self.seed}"


@dataclass(frozen=True)
class Answers:
    """The answers of one trial; an optional one is None where the method or the task has none."""

    trial: Trial
    """Which."""
    readings: tuple[np.ndarray, ...]
    """Predicted (T, d), one a query touch."""
    mean: np.ndarray | None = None
    """Stiffness at the reached points (k,)."""
    column_mean: np.ndarray | None = None
    """Stiffness in the columns of the mask (q,)."""
    pose: np.ndarray | None = None
    """Object-to-world transform (4, 4) of the hidden object."""
    adapt_s: float = 0.0
    """Seconds of `adapt`."""
    predict_s: float = 0.0
    """Seconds of all other functions."""


@dataclass(frozen=True)
class Fold:
    """One division of a dataset's object views."""

    number: int
    """From 0."""
    train: tuple[str, ...]
    """Names of the views that methods learn from."""
    test: tuple[str, ...]
    """Names of the views that are scored."""


def folds_of(dataset: Dataset, protocol: Protocol) -> tuple[Fold, ...]:
    """The folds of a task; one fold, of its two splits, for a task without cross-validation.

    Raises:
        TaskError: there are fewer objects than folds.
    """
    if not protocol.folds:
        return (Fold(0, tuple(dataset.names(protocol.train)), tuple(dataset.names(protocol.test))),)
    objects = np.array(sorted({entry.object_index for entry in dataset.entries}), dtype=int)
    if len(objects) < protocol.folds:
        raise TaskError(f"the dataset in {dataset.path} has {len(objects)} objects, and the task divides them into "
                        f"{protocol.folds} folds. Generate more objects, or lower folds in a task of your own.")
    order = np.random.default_rng(np.random.SeedSequence(protocol.seed, spawn_key=(2,))).permutation(objects)
    number = {int(index): place % protocol.folds for place, index in enumerate(order)}
    return tuple(Fold(k, tuple(e.name for e in dataset.entries if number[e.object_index] != k),
                      tuple(e.name for e in dataset.entries if number[e.object_index] == k))
                 for k in range(protocol.folds))


def test_names(dataset: Dataset, protocol: Protocol) -> tuple[str, ...]:
    """Names of all object views that are scored, fold by fold."""
    return tuple(name for fold in folds_of(dataset, protocol) for name in fold.test)
