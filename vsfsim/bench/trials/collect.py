"""All trials of a method on a task, several at once, seed by seed; finished seeds are kept and taken up again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.isolation.process import Description, MethodProcess
from vsfsim.bench.method import Specimen
from vsfsim.bench.protocol import specimen, support
from vsfsim.bench.task import ALL, Task
from vsfsim.bench.trials import answers as kept
from vsfsim.bench.trials.answers import Answers, run_trial
from vsfsim.bench.trials.subject import Subject, Trial
from vsfsim.core.errors import Interrupted, MethodError
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic

_NOTE = "evaluation.json"

Progress = Callable[[int, int, str], None]


@dataclass
class Collector:
    """One method on one task.

    Until `run` returns, nothing of the truth but the places of the probed points has been read.
    """

    name: str
    """Of the method."""
    parameters: dict[str, Any]
    """Of its constructor, over its defaults."""
    task: Task
    """The task."""
    dataset: Dataset
    """Its dataset."""
    seeds: tuple[int, ...]
    """Draws of the support set."""
    isolation: Isolation
    """How the method is run."""
    log: Path
    """What the method prints."""
    part: Path | None
    """Folder in which finished seeds are kept, or None."""
    progress: Progress
    """Called with (trials done, of how many, what is going on)."""
    conforms: bool = True
    """Test the contract first."""
    meta_fit_s: float = 0.0
    """Seconds of all calls of `meta_fit`."""
    peak_memory_mib: float = 0.0
    """Largest resident size of the method's processes [MiB]."""
    description: Description | None = None
    """What the method said of itself."""
    done: dict[int, list[Answers]] = field(default_factory=dict)
    """By seed."""
    _key: bytes = b""  # what the kept seeds are of

    def run(self) -> list[Answers]:
        """The answers of all trials, in the task's order; those of shots that are the same for every seed are repeated.

        Raises:
            MethodError: the method does not conform, raises, or answers with something that cannot be scored.
            TaskError: the dataset has too few touches.
            Interrupted: the user has stopped it.
        """
        subjects = [Subject.of(name, self.task, self.dataset) for name in self.dataset.names(self.task.protocol.test)]
        hidden = [self.dataset.path.resolve(), self.task.dataset.path().parent.resolve(), Path("results").resolve()]
        process: MethodProcess | None = None
        try:
            process = self._process(hidden)
            self.description = process.description
            self._take_up(process.description)
            if self.conforms and not self.done:
                self.progress(0, 1, "contract")
                failed = process.check()
                if failed:
                    raise MethodError(f"{self.name} does not keep the contract of a method: "
                                      + "; ".join(f"{clause}: {detail}" for clause, detail in failed)
                                      + f" `vsfsim check {self.name}` tests all of it.")
            blind = self.dataset.blind()
            specimens = [specimen(blind.load(name), self.task) for name in self.dataset.names(self.task.protocol.train)]
            fitted = False
            for seed in self.seeds:
                if seed in self.done:
                    continue
                if self.description.seeded and fitted:
                    self._end(process)
                    process, fitted = self._process(hidden), False
                if not fitted:
                    self._learn(process, specimens, seed if self.description.seeded else None)
                    fitted = True
                self._run_seed(process, subjects, seed)
        except KeyboardInterrupt as stop:
            raise Interrupted(self._how_to_go_on()) from stop
        finally:
            if process is not None:
                self._end(process)
        return self._in_order(subjects)


    # ------------------------------------------------------------------ one seed

    def _process(self, hidden: Sequence[Path]) -> MethodProcess:
        return MethodProcess(self.name, self.parameters, self.isolation, self.log, hidden=hidden)

    def _end(self, process: MethodProcess) -> None:
        process.close()
        self.peak_memory_mib = max(self.peak_memory_mib, process.peak_memory_mib)

    def _learn(self, process: MethodProcess, specimens: list[Specimen], seed: int | None) -> None:
        self.progress(self._count(self.done), self._count(self.seeds), "meta-fit")
        self.meta_fit_s += process.meta_fit(specimens, seed=seed)

    def _shots(self, seed: int) -> tuple[str, ...]:
        """The shots that are run at ``seed``.

        A method without a `seed` must be deterministic, so a support set that is the same for every seed needs only one
        adaptation.
        """
        assert self.description is not None
        labels = self.task.protocol.labels
        if self.description.seeded or seed == self.seeds[0]:
            return labels
        return tuple(label for label in labels if label not in ("0", ALL))

    def _count(self, seeds: Any) -> int:
        objects = len(self.dataset.names(self.task.protocol.test))
        return objects * sum(len(self._shots(seed)) for seed in seeds)

    def _run_seed(self, process: MethodProcess, subjects: Sequence[Subject], seed: int) -> None:
        trials = [(subject, Trial(subject.name, label, seed, self._support(subject, label, seed)))
                  for subject in subjects for label in self._shots(seed)]
        before, total = self._count(self.done), self._count(self.seeds)
        finished = 0
        with ThreadPoolExecutor(self.isolation.workers) as pool:
            try:
                futures = []
                for subject, trial in trials:
                    future = pool.submit(run_trial, process, subject, trial)
                    futures.append(future)
                pending = set(futures)
                while pending:
                    ready, pending = wait(pending, timeout=0.5, return_when=FIRST_EXCEPTION) if (
                        self.isolation.workers > 1) else ({futures[finished]}, pending - {futures[finished]})
                    for future in ready:
                        future.result()
                        finished += 1
                        where = trials[min(finished, len(trials) - 1)][1].where
                        self.progress(before + finished, total, where)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                process.close()  # ends what still runs, so that the threads end as well
                raise
        self.done[seed] = [future.result() for future in futures]
        self._keep(seed)

    def _support(self, subject: Subject, label: str, seed: int) -> tuple[int, ...]:
        return support(subject, subject.draw, label, seed, self.task.protocol)

    def _in_order(self, subjects: Sequence[Subject]) -> list[Answers]:
        out = []
        first = {(one.trial.subject, one.trial.shot): one for one in self.done[self.seeds[0]]}
        for seed in self.seeds:
            mine = {(one.trial.subject, one.trial.shot): one for one in self.done[seed]}
            for subject in subjects:
                for label in self.task.protocol.labels:
                    one = mine.get((subject.name, label))
                    if one is None:  # the same support set as at the first seed
                        same = first[subject.name, label]
                        trial = Trial(subject.name, label, seed, same.trial.support)
                        one = Answers(trial, same.readings, same.readings_std, same.mean, same.std, same.column_mean,
                                      same.pose, 0.0, 0.0)
                    out.append(one)
        return out

    # ------------------------------------------------------------------ interruption

    def _take_up(self, description: Description) -> None:
        """Read the seeds that an earlier run of the same evaluation kept."""
        if self.part is None:
            return
        made = {"task": self.task.sha256, "dataset": self.dataset.sha256, "method": self.name,
                "entry": description.entry, "parameters": dict(description.parameters),
                "package": [description.package, description.version], "sandbox": self.isolation.sandbox}
        self._key = json.dumps(made, sort_keys=True).encode()
        if (self.part / _NOTE).is_file() and (self.part / _NOTE).read_bytes() == self._key:
            for seed in self.seeds:
                found = kept.load(self.part / f"seed-{seed:04d}.npz")
                if found is not None:
                    self.done[seed] = found
            if self.done and self.seeds[0] not in self.done:
                self.done.clear()  # the shots that are the same for every seed are in the first

    def _keep(self, seed: int) -> None:
        """Put the answers of a finished seed on disk; the folder is made with the first of them."""
        if self.part is None:
            return
        try:
            if not self.part.is_dir() or (self.part / _NOTE).read_bytes() != self._key:
                shutil.rmtree(self.part, ignore_errors=True)
                self.part.mkdir(parents=True)
                write_atomic(self.part / _NOTE, self._key, error=MethodError)
        except OSError as error:
            raise MethodError(f"folder {self.part} cannot be made: {error.strerror}. Choose another --out.") from error
        kept.save(self.part / f"seed-{seed:04d}.npz", self.done[seed])

    def _how_to_go_on(self) -> str:
        if self.part is None or not self.done:
            return "interrupted; no seed was finished, so nothing is kept."
        return (f"interrupted; {len(self.done)} of {len(self.seeds)} seeds are finished and kept in {self.part}. Run "
                f"the same command again to go on, or delete that folder to start again.")
