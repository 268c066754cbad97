"""Object views of a dataset as methods meet them, each read from its file once for all trainings of an evaluation."""

from __future__ import annotations

from collections.abc import Hashable, Iterable

from vsfsim.bench.method import Specimen
from vsfsim.bench.protocol import record, specimen_of
from vsfsim.bench.task import Task
from vsfsim.bench.trials.subject import Subject
from vsfsim.data.dataset import Dataset


class Reader:
    """Reads the object views that methods learn from and are asked about, without their truth but for the places of the
    probed points.

    A view of 60 touches takes a second to read, and every fold learns from most of the others' views. Trainings that
    are forks of one process share what was read before (`vsfsim.bench.commands.side_by_side`).
    """

    def __init__(self) -> None:
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
        if key not in self._subjects:
            view, places = dataset.shown(name)
            recording = record(view, task)
            self._subjects[key] = Subject.of(view, places, recording, task, dataset)
            self._specimens.setdefault(readings, specimen_of(view, recording))
        return self._subjects[key]

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


def _readings(task: Task, dataset: Dataset, name: str) -> tuple[Hashable, ...]:
    """What decides how the touches of an object view read."""
    return dataset.path, name, task.observation.name, task.noise
