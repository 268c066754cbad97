"""Object views of a dataset as methods meet them, each read from its file once for all trainings of an evaluation."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections.abc import Hashable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from vsfsim.bench.method import Specimen
from vsfsim.bench.protocol import record, specimen_of
from vsfsim.bench.task import Task
from vsfsim.bench.trials.subject import Subject
from vsfsim.core.errors import TaskError
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
        readings, key = _readings(task, dataset, name), self._key(task, dataset, name)
        if key not in self._subjects:
            view, places = dataset.shown(name)
            recording = record(view, task)
            self._subjects[key] = Subject.of(view, places, recording, task, dataset)
            self._specimens.setdefault(readings, specimen_of(view, recording))
        return self._subjects[key]

    def read(self, task: Task, dataset: Dataset, *, test: Iterable[str], train: Iterable[str],
             processes: int = 1) -> None:
        """Read views in advance.

        Args:
            task, dataset: as for `subject`. test: names of the views that are asked about. train: of those to learn
            from. processes: that read at the same time.

        Raises:
            TaskError: as `subject`.
        """
        test = [name for name in dict.fromkeys(test) if self._key(task, dataset, name) not in self._subjects]
        if processes > 1 and len(test) > 1:
            self._read_beside(task, dataset, test, min(processes, len(test)))
        for name in test:
            self.subject(task, dataset, name)
        for name in train:
            self.specimen(task, dataset, name)

    def _read_beside(self, task: Task, dataset: Dataset, names: Sequence[str], processes: int) -> None:
        pool = ProcessPoolExecutor(processes, multiprocessing.get_context("fork"), _Reading.begin, (task, dataset))
        try:
            for name, (content, buffers) in zip(names, pool.map(_Reading.subject, names)):
                specimen, subject = pickle.loads(content, buffers=buffers)
                self._subjects[self._key(task, dataset, name)] = subject
                self._specimens.setdefault(_readings(task, dataset, name), specimen)
        except BrokenProcessPool as error:
            raise TaskError(f"a process that read the dataset in {dataset.path} was ended from outside; often memory "
                            f"was short. Ask for fewer processes.") from error
        finally:
            pool.shutdown(cancel_futures=True)

    @staticmethod
    def _key(task: Task, dataset: Dataset, name: str) -> tuple[Hashable, ...]:
        # a study asks a task by a protocol of its own
        return (*_readings(task, dataset, name), task.protocol, task.primary)


class _Reading:
    """A process of a pool, which has the task and the dataset from its parent: a task cannot be pickled."""

    of: tuple[Task, Dataset]

    @classmethod
    def begin(cls, task: Task, dataset: Dataset) -> None:
        """In a new process."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted, and ends its pool
        cls.of = task, dataset

    @classmethod
    def subject(cls, name: str) -> tuple[bytes, list[bytes]]:
        """A view as training and as test object, pickled. Its arrays are buffers of their own, from which they come
        back read-only, as they were."""
        read = Reader()
        buffers: list[pickle.PickleBuffer] = []
        found = read.subject(*cls.of, name)
        content = pickle.dumps((read.specimen(*cls.of, name), found), protocol=5, buffer_callback=buffers.append)
        return content, [bytes(b) for b in buffers]


def _readings(task: Task, dataset: Dataset, name: str) -> tuple[Hashable, ...]:
    """What decides how the touches of an object view read, and which of them are learned from."""
    return dataset.path, name, task.observation.name, task.noise, task.protocol.transfer
