"""A test object as a method meets it: everything that is asked, without the truth and without a reading of a query."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.bench.inclusions import Columns, Inclusions
from vsfsim.bench.method import Action, Reading, frozen_view
from vsfsim.bench.metrics import Answer
from vsfsim.bench.protocol import Draw, Recording, divide, support
from vsfsim.bench.reached_points import reached
from vsfsim.bench.stiffness_metrics import FEWEST_POINTS
from vsfsim.bench.task import Protocol, Task
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, View


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
    pool: dict[int, Reading]
    """The touches that may be given, by index."""
    plans: dict[int, Action]
    """Of the same touches before they are made."""
    actions: tuple[Action, ...]
    """Of the query touches."""
    points: np.ndarray
    """Where the stiffness is asked, world (k, 3) [m]: the probed surface points that some touch reached."""
    columns: np.ndarray | None
    """Where the stiffness is asked for a mask, world (q, 3) [m]; None where the task does not rank by one."""
    hidden: tuple[np.ndarray, np.ndarray] | None
    """Vertices (n, 3) [m] and triangles (m, 3) of the object that is to be located; None where the task does not rank
    by its pose."""

    @classmethod
    def of(cls, view: ObjectView, places: np.ndarray, recording: Recording, task: Task, dataset: Dataset) -> Subject:
        """A test object.

        Args:
            view: without its truth. places: of its probed points, world (P, 3) [m]. recording: of its touches. task:
            whose protocol it is asked by. dataset: where it is.

        Raises:
            TaskError: it has too few touches.
        """
        draw = divide(view, task.protocol)
        inclusions, ranked = None, task.metric.answer
        if ranked in (Answer.MASK, Answer.POSE):
            inclusions = Inclusions.of(dataset.recipe, view)
        columns = Columns.of(places, view).points if ranked is Answer.MASK else None
        hidden = inclusions.known_object()[:2] if inclusions is not None and ranked is Answer.POSE else None
        return cls(view.name, view.object_index, view.view_index, frozen_view(view.view), draw,
                   {i: recording.readings[i] for i in draw.pool}, {i: recording.queries[i].action for i in draw.pool},
                   tuple(recording.queries[i].action for i in draw.query),
                   places[touched(places, view)], columns, hidden)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the query touches, for messages."""
        return tuple(f"touch {i}" for i in self.draw.query)

    @property
    def asks_stiffness(self) -> bool:
        """Whether enough points were reached."""
        return len(self.points) >= FEWEST_POINTS


def asked_of(subject: Subject, label: str, run: int, protocol: Protocol) -> Trial:
    """The trial of a test object at shot ``label`` in a run."""
    draw, pool = protocol.draw_of(run), subject.draw.pool
    given = support(subject, subject.draw, label, draw, protocol)
    choice = protocol.chosen and 0 < len(given) < len(pool)
    return Trial(subject.name, label, run, given,
                 support(subject, subject.draw, str(len(pool)), draw, protocol) if choice else ())


def touched(points: np.ndarray, view: ObjectView) -> np.ndarray:
    """Which of the probed points (P, 3) [m] some touch of ``view`` reached (P,) bool."""
    near = np.zeros(len(points), bool)
    for touch in view.touches:
        left = np.flatnonzero(~near)
        near[left] = reached(points[left], view.probe_of(touch), touch.mount_pose, q=touch.q)
    return near
