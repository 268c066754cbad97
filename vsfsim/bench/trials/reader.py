"""Object views of a dataset as methods meet them, each read from its file once for all trainings of an evaluation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from vsfsim.bench.method import Specimen
from vsfsim.bench.protocol import record, specimen_of
from vsfsim.bench.task import Task
from vsfsim.bench.trials.subject import Subject
from vsfsim.data.dataset import Dataset


@dataclass(frozen=True)
class _Known:
    """What came of one file."""

    specimen: Specimen
    subject: Subject | None
    """None until it was asked for."""


class Reader:
    """Reads the object views that methods learn from and are asked about, without their truth but for the places of the
    probed points.

    A view of 60 touches takes a second to read, and every fold learns from most of the others' views. Trainings that
    are forks of one process share what was read before (`vsfsim.bench.commands.side_by_side`).
    """

    def __init__(self) -> None:
        self._known: dict[tuple[Path, str, str], _Known] = {}

    def specimen(self, task: Task, dataset: Dataset, name: str) -> Specimen:
        """A training object as a method receives it.

        Args:
            task: whose noise and observation its readings have. dataset: where it is. name: of the object view.

        Raises:
            TaskError: it does not hold what the task reads.
        """
        key = (dataset.path, task.name, name)
        if key not in self._known:
            view = dataset.blind().load(name)
            self._known[key] = _Known(specimen_of(view, record(view, task)), None)
        return self._known[key].specimen

    def subject(self, task: Task, dataset: Dataset, name: str) -> Subject:
        """A test object as a method meets it.

        Args:
            task: whose protocol it is asked by. dataset: where it is. name: of the object view.

        Raises:
            TaskError: it has too few touches, or not what the task reads.
        """
        key = (dataset.path, task.name, name)
        known = self._known.get(key)
        if known is None or known.subject is None:
            view, places = dataset.shown(name)
            recording = record(view, task)
            subject = Subject.of(view, places, recording, task, dataset)
            specimen = specimen_of(view, recording) if known is None else known.specimen
            known = self._known[key] = _Known(specimen, subject)
        assert known.subject is not None
        return known.subject

    def read(self, task: Task, dataset: Dataset, *, test: Iterable[str], train: Iterable[str]) -> None:
        """Read views in advance.

        Args:
            task, dataset: as for `subject`. test: names of the views that are asked about. train: of those to learn
            from.

        Raises:
            TaskError: as `subject`.
        """
        for name in test:
            self.subject(task, dataset, name)
        for name in train:
            self.specimen(task, dataset, name)
