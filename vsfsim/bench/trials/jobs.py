"""An evaluation is a list of jobs: one training, and all trials after it. What a job answered is kept by what decided
it, so that an evaluation goes on where it was stopped, whoever made which job."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.identity import contents_of, package_of, versions_of
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.isolation.process import UNKNOWN, Description, MethodHost
from vsfsim.bench.protocol import Answers, Fold, Trial
from vsfsim.bench.result import Result, versions
from vsfsim.bench.task import ALL, Task
from vsfsim.bench.trials.answers import Done, Reader, asked_of, load, run_trial, save
from vsfsim.bench.trials.score import result_of
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.system.content import differences, file_sha256
from vsfsim.data.dataset import Dataset

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Job:
    """One training, and the runs that use it."""

    name: str
    """Of the file in which its answers are kept."""
    fold: Fold
    """The views that the method learns from, and those that are scored."""
    seed: int | None
    """That the method is built with; None for a method without one."""
    runs: tuple[int, ...]
    """Numbers of the runs."""

    def asked(self, labels: Iterable[str]) -> list[tuple[int, str, str]]:
        """Run, view and shot of each trial. The support set of 0 touches and that of all of them are the same in every
        run, so that they are asked in the first."""
        return [(run, name, label) for run in self.runs for name in self.fold.test for label in labels
                if run == self.runs[0] or label not in ("0", ALL)]


@dataclass
class Evaluation(contextlib.AbstractContextManager["Evaluation"]):
    """One method on one task.

    Until its answers are scored, nothing of the truth but the places of the probed points is read.
    """

    method: str
    """Name of an installed method, or module:attribute."""
    task: Task
    """The task."""
    dataset: Dataset
    """Its dataset."""
    path: Path
    """File of its result. What its jobs answered is kept beside it until all is there (`parts`)."""
    parameters: Mapping[str, Any] = field(default_factory=dict)
    """Of the method's constructor, over its defaults."""
    draws: int | None = None
    """Draws of the support set, None for the task's own number; with cross-validation, of one training."""
    isolation: Isolation = field(default_factory=Isolation)
    """How the method is run."""
    training: Training = PLAIN
    """What the method learns from, and which objects are scored."""
    preset: str = ""
    """Name of the settings, for the leaderboard; they are in ``parameters`` already."""
    said: Description = UNKNOWN
    """What the method said of itself, once `look` was called."""
    contents: Mapping[str, str] = field(default_factory=dict)
    """What decides its answers (`vsfsim.bench.identity.contents_of`), once `look` was called."""

    def __exit__(self, *_: object) -> None:
        self.stop()
        if not any(self.parts.glob("*/*")):  # nothing to go on with: nothing is left behind
            self._log.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                self.parts.rmdir()

    @property
    def parts(self) -> Path:
        """Folder of what its jobs answered, in a folder for each thing that decides answers."""
        return self.path.with_suffix(".parts").absolute()

    @functools.cached_property
    def host(self) -> MethodHost:
        """What runs the method's processes, of all jobs that are made here; they print into one log."""
        hidden = [self.dataset.path.resolve(), self.task.dataset.path().parent.resolve(), Path("results").resolve(),
                  self.parts.resolve()]
        self.parts.mkdir(parents=True, exist_ok=True)
        return MethodHost(self.method, self.parameters, self.isolation, self._log, hidden=hidden)

    @property
    def _log(self) -> Path:
        return self.parts / f"{platform.node()}-{os.getpid()}.log"

    def stop(self) -> None:
        """End the method's processes; jobs that other threads make fail."""
        host = self.__dict__.pop("host", None)  # at once, as several threads may stop
        if host is not None:
            host.close()

    def look(self, *, check: bool) -> None:
        """Import the method in a process of its own, and test its contract if ``check``.

        Raises:
            MethodError: it is unknown, or breaks its contract.
        """
        self.said = self.host.look(check=check and not any(self.parts.glob("*/*.answers")))
        self.contents = contents_of(self.method, self.said.parameters, opened=self.host.folders)

    @property
    def runs(self) -> tuple[int, ...]:
        """Numbers of the runs (`vsfsim.bench.task.Protocol`).

        Raises:
            TaskError: more draws are asked for than the task has.
        """
        protocol = self.task.protocol
        if self.draws is None:
            return protocol.runs(seeded=self.said.seeded)
        if protocol.folds and self.draws > protocol.draws:
            raise TaskError(f"{self.draws} draws of the support set were asked for; task {self.task.name} has "
                            f"{protocol.draws} of each training.")
        return tuple(range(self.draws))

    @functools.cached_property
    def jobs(self) -> tuple[Job, ...]:
        """All of them, in the order of their trainings.

        Raises:
            TaskError: the dataset does not fit the task or the training.
        """
        protocol, seeded, runs = self.task.protocol, self.said.seeded, self.runs
        of = protocol.training_of if protocol.folds else (lambda run: run if seeded else 0)
        folds = self.training.folds(self.dataset, protocol)
        return tuple(Job(f"fold-{fold.number:02d}-training-{k:02d}", fold, k if seeded else None,
                         tuple(run for run in runs if of(run) == k))
                     for k in sorted(set(map(of, runs))) for fold in folds)

    def trials(self, job: Job) -> int:
        """Number of its trials."""
        return len(job.asked(self.task.protocol.labels))

    @property
    def left(self) -> list[Job]:
        """The jobs that are not kept."""
        return [job for job in self.jobs if load(self._file(job)) is None]

    # ------------------------------------------------------------------ one job

    def make(self, job: Job, reader: Reader, pool: Executor, tell: Callable[[int, str], None] = lambda *_: None,
             environment: Mapping[str, str] | None = None) -> None:
        """Train, run the trials, and keep the answers.

        Args:
            job: the job. reader: what reads the object views. pool: runs the training and the trials. tell: called with
            (trials done since the last call, what is going on). environment: further variables of the method's
            processes.

        Raises:
            MethodError: the method raises, answers with something that cannot be scored, or was changed meanwhile.
            TaskError: the dataset has too few touches.
        """
        subjects = {name: reader.subject(self.task, self.dataset, name) for name in job.fold.test}
        specimens = self.training.specimens(self.task, self.dataset, job.fold, job.seed or 0, reader.specimen)
        self._check_contents()
        tell(0, f"{self.parts.stem} {job.name}: meta-fit")
        learned = pool.submit(self.host.learn, specimens, seed=job.seed, environment=environment).result()
        opened = contents_of(self.method, self.said.parameters, opened=(*self.contents, *learned.opened))
        trials = [pool.submit(run_trial, self.host, learned, subjects[name],
                              asked_of(subjects[name], label, run, self.task.protocol))
                  for run, name, label in job.asked(self.task.protocol.labels)]
        try:
            for one in trials:
                tell(1, f"{self.parts.stem}: {one.result().trial.where}")
        except BaseException:
            for one in trials:
                one.cancel()
            raise
        self._check_contents(opened)
        new = tuple(name for name in opened if name not in self.contents)
        save(self._file(job), Done(tuple(one.result() for one in trials), learned.seconds,
                                   self.host.peak_memory_mib, new))

    def _check_contents(self, known: Mapping[str, str] | None = None) -> None:
        """Raises:
            MethodError: what decides the answers is no longer what it was when the evaluation began.
        """
        known = self.contents if known is None else known
        odd = differences(known, contents_of(self.method, self.said.parameters, opened=tuple(known)))
        if odd:
            raise MethodError(f"{self.method} was changed while it was evaluated: {'; '.join(odd)}. Its answers would "
                              f"be of two methods; run the same command again, and what the change touches is made "
                              f"again.")

    # ------------------------------------------------------------------ all jobs

    def finish(self) -> Result:
        """Score the kept answers, write the result and what the method printed, and remove what was kept.

        Raises:
            MethodError: an answer is missing.
        """
        answers, done = self.answers()
        said, task, study = self.said, self.task, self.training.table()
        timing = {"meta_fit_s": sum(job.meta_fit_s for job in done), "fits": len(done),
                  "adapt_s": sum(a.adapt_s for a in answers), "predict_s": sum(a.predict_s for a in answers),
                  "adapts": sum(a.adapt_s > 0.0 for a in answers),
                  "predicts": sum(len(a.readings) for a in answers if a.adapt_s > 0.0)}
        wanted = len(task.protocol.runs(seeded=said.seeded))
        notes = [f"{len(self.runs)} seeds instead of the task's {wanted}"] * (len(self.runs) != wanted)
        opened = {name: file_sha256(Path(name)) for job in done for name in job.opened}
        result = result_of(
            answers, task, self.dataset, self.runs, method=self.method, entry=said.entry,
            parameters=dict(said.parameters), timing=timing, notes=tuple(notes), preset=self.preset,
            peak_memory_mib=round(max(job.peak_memory_mib for job in done), 1),
            package=dict(zip(("name", "version"), package_of(self.method))), isolation=self.isolation.sandbox,
            contents={**self.contents, **opened}, study=study,
            data={} if study else fingerprint.beside_record(task, self.dataset),
            versions={**versions_of(self.method), **versions()})
        result.save(self.path)
        log_of(self.path).unlink(missing_ok=True)
        if text := "".join(log.read_text(errors="replace") for log in sorted(self.parts.glob("*.log"))):
            log_of(self.path).write_text(text)
        shutil.rmtree(self.parts, ignore_errors=True)
        return result

    def answers(self) -> tuple[list[Answers], list[Done]]:
        """The answers of all trials in the task's order, those of a support set that is the same in several runs
        repeated; and the jobs.

        Raises:
            MethodError: an answer is missing.
        """
        done = [one for one in (load(self._file(job)) for job in self.jobs) if one is not None]
        if len(done) < len(self.jobs):
            raise MethodError(f"{len(self.jobs) - len(done)} of {len(self.jobs)} trainings of {self.method} are not in "
                              f"{self._folder}. Run the command without a --shard to make them.")
        known = {(a.trial.subject, a.trial.shot, a.trial.seed): a for one in done for a in one.answers}
        first = {run: job.runs[0] for job in self.jobs for run in job.runs}
        out = []
        for run in self.runs:
            for name in dict.fromkeys(n for job in self.jobs for n in job.fold.test):
                for label in self.task.protocol.labels:
                    same = known.get((name, label, run)) or known[name, label, first[run]]
                    out.append(same if same.trial.seed == run else replace(
                        same, trial=Trial(name, label, run, same.trial.support), adapt_s=0.0, predict_s=0.0))
        return out, done

    @property
    def _folder(self) -> Path:
        """Of the answers that the same operands, sources and files gave."""
        decided = {"task": self.task.sha256, "dataset": self.dataset.sha256, "method": self.method,
                   "entry": self.said.entry, "parameters": dict(self.said.parameters),
                   "sandbox": self.isolation.sandbox, "contents": dict(self.contents),
                   "training": self.training.table(),
                   "shots": list(self.task.protocol.labels), "runs": len(self.runs)}
        return self.parts / hashlib.sha256(json.dumps(decided, sort_keys=True).encode()).hexdigest()[:16]

    def _file(self, job: Job) -> Path:
        return self._folder / f"{job.name}.answers"


def log_of(result: Path) -> Path:
    """The file beside a result that holds what the method printed: RESULT.json.log, as RESULT.log may be the user's."""
    return result.with_name(result.name + ".log")
