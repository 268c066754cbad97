"""All trials of a method on a task, several at once, stage by stage: a training, and the runs that use it. Finished
stages are kept and taken up again."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vsfsim.bench.folds import Fold
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.isolation.process import Description, MethodProcess
from vsfsim.bench.method import contents_of
from vsfsim.bench.protocol import Trial
from vsfsim.bench.task import ALL, Protocol, Task
from vsfsim.bench.trials.answers import Answers, Reader, Subject, asked_of, load, run_trial, save
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.core.errors import Interrupted, MethodError, TaskError
from vsfsim.core.plain_text import from_json
from vsfsim.core.system.content import differences
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic


@dataclass(frozen=True)
class Stage:
    """Some runs on the test objects of one fold, after one training."""

    name: str
    """Of the file in which its answers are kept."""
    fold: int
    """Number of the fold."""
    train: tuple[str, ...]
    """Names of the views that the method learns from."""
    test: tuple[str, ...]
    """Names of the views that are scored."""
    seed: int | None
    """That the method is built with; None for a method without one."""
    runs: tuple[int, ...]
    """Numbers of the runs."""
    complete: tuple[int, ...]
    """Runs with the shots whose support set is the same in every draw: 0 touches and all of them."""

    def shots(self, run: int, protocol: Protocol) -> tuple[str, ...]:
        """Labels of the shots that are made in a run.

        Without a ``seed`` a method must be deterministic, so that a support set that is the same in every draw needs
        only one adaptation after a training.
        """
        return tuple(label for label in protocol.labels if run in self.complete or label not in ("0", ALL))

    def trials(self, protocol: Protocol) -> int:
        """Number of adaptations."""
        return len(self.test) * sum(len(self.shots(run, protocol)) for run in self.runs)


def first_run(protocol: Protocol, run: int, runs: Sequence[int], *, seeded: bool) -> int:
    """The run after the same training in which the shots with one support set for all draws are made."""
    if not protocol.folds:
        return run if seeded else runs[0]
    return next(one for one in runs if protocol.training_of(one) == protocol.training_of(run))


def stages(protocol: Protocol, folds: Sequence[Fold], runs: Sequence[int], *, seeded: bool) -> tuple[Stage, ...]:
    """The stages of an evaluation in their order, so that those with the same training follow one another.

    Args:
        protocol: of the task. folds: of its dataset. runs: to be made. seeded: the method takes a ``seed``.
    """
    complete = tuple(run for run in runs if first_run(protocol, run, runs, seeded=seeded) == run)
    if not protocol.folds:  # one training for all seeds, or one a seed
        (fold,) = folds
        return tuple(Stage(f"seed-{run:04d}", fold.number, fold.train, fold.test, run if seeded else None, (run,),
                           complete) for run in runs)
    trainings = sorted({protocol.training_of(run) for run in runs})
    return tuple(Stage(f"fold-{fold.number:02d}-training-{k:02d}", fold.number, fold.train, fold.test,
                       k if seeded else None, tuple(run for run in runs if protocol.training_of(run) == k), complete)
                 for k in trainings for fold in folds)


NOTE = "evaluation.json"
"""File in the folder of kept stages that says of what they are."""

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
    draws: int | None
    """Draws of the support set, None for the task's own number; with cross-validation, of one training."""
    isolation: Isolation
    """How the method is run."""
    log: Path
    """What the method prints."""
    part: Path | None
    """Folder in which finished stages are kept, or None."""
    progress: Progress
    """Called with (trials done, of how many, what is going on)."""
    conforms: bool = True
    """Test the contract first."""
    training: Training = PLAIN
    """What the method learns from, and which objects are scored."""
    only: str | None = None
    """Name of the one stage that is made and kept in `part`, or None for all of them."""
    read: Reader = field(default_factory=Reader)
    """Where object views come from; give one that has read them already."""
    meta_fit_s: float = 0.0
    """Seconds of all calls of `meta_fit`."""
    fits: int = 0
    """Number of those calls."""
    peak_memory_mib: float = 0.0
    """Largest resident size of the method's processes [MiB]."""
    description: Description | None = None
    """What the method said of itself."""
    contents: dict[str, str] = field(default_factory=dict)
    """What decides its answers (`vsfsim.bench.method.contents_of`), once the method is known."""
    notes: list[str] = field(default_factory=list)
    """For the user, one sentence each."""
    seeds: tuple[int, ...] = ()
    """Numbers of the runs (`vsfsim.bench.task.Protocol`), once the method is known."""
    done: dict[str, list[Answers]] = field(default_factory=dict)
    """By stage."""
    _key: bytes = b""  # what the kept stages are of
    _stages: tuple[Stage, ...] = ()
    _told: tuple[float, int] = (0.0, 0)  # seconds and number of trainings that kept stages hold

    @property
    def _unit(self) -> str:
        return "training" if self.task.protocol.folds else "seed"

    def run(self) -> list[Answers]:
        """The answers of all trials, in the task's order; those of shots that are the same for every seed are repeated.
        Empty with `only`.

        Raises:
            MethodError: the method does not conform, raises, or answers with something that cannot be scored.
            TaskError: the dataset has too few touches.
            Interrupted: the user has stopped it.
        """
        folds = self.training.folds(self.dataset, self.task.protocol)
        hidden = [self.dataset.path.resolve(), self.task.dataset.path().parent.resolve(), Path("results").resolve()]
        process: MethodProcess | None = None
        try:
            process = self._process(hidden)
            self.description = process.description
            self.contents = contents_of(self.name, process.description.parameters)
            self.seeds = self._runs()
            self._stages = tuple(s for s in stages(self.task.protocol, folds, self.seeds,
                                                   seeded=self.description.seeded) if self.only in (None, s.name))
            self._take_up(process.description)
            left = [stage for stage in self._stages if stage.name not in self.done]
            subjects = {name: self.read.subject(self.task, self.dataset, name)
                        for name in dict.fromkeys(n for stage in left for n in stage.test)}
            if self.conforms and not self.done:
                self.progress(0, 1, "contract")
                process.require()
            fitted: tuple[int, int | None] | None = None
            for stage in left:
                if fitted is not None and fitted != (stage.fold, stage.seed):
                    self._end(process)
                    process, fitted = self._process(hidden), None
                if fitted is None:
                    self._learn(process, stage)
                    fitted = stage.fold, stage.seed
                self._run_stage(process, [subjects[name] for name in stage.test], stage)
        except KeyboardInterrupt as stop:
            raise Interrupted(self._how_to_go_on()) from stop
        finally:
            if process is not None:
                self._end(process)
        return [] if self.only is not None else self._in_order(
            list(dict.fromkeys(n for stage in self._stages for n in stage.test)))

    # ------------------------------------------------------------------ one stage

    def _runs(self) -> tuple[int, ...]:
        assert self.description is not None
        protocol = self.task.protocol
        if self.draws is None:
            return protocol.runs(seeded=self.description.seeded)
        if protocol.folds and self.draws > protocol.draws:
            raise TaskError(f"{self.draws} draws of the support set were asked for; task {self.task.name} has "
                            f"{protocol.draws} of each training.")
        return tuple(range(self.draws))

    def _process(self, hidden: Sequence[Path]) -> MethodProcess:
        return MethodProcess(self.name, self.parameters, self.isolation, self.log, hidden=hidden)

    def _end(self, process: MethodProcess) -> None:
        process.close()
        self.peak_memory_mib = max(self.peak_memory_mib, process.peak_memory_mib)

    def _learn(self, process: MethodProcess, stage: Stage) -> None:
        self.progress(self._finished(), self._total(), "meta-fit")
        specimens = self.training.specimens(self.task, self.dataset, stage.fold, stage.train, stage.seed or 0,
                                            self.read.specimen)
        self.meta_fit_s += process.meta_fit(specimens, seed=stage.seed)
        self.fits += 1

    def _finished(self) -> int:
        return sum(stage.trials(self.task.protocol) for stage in self._stages if stage.name in self.done)

    def _total(self) -> int:
        return sum(stage.trials(self.task.protocol) for stage in self._stages)

    def _run_stage(self, process: MethodProcess, subjects: Sequence[Subject], stage: Stage) -> None:
        protocol = self.task.protocol
        trials = [(subject, asked_of(subject, label, run, protocol))
                  for run in stage.runs for subject in subjects for label in stage.shots(run, protocol)]
        before, total = self._finished(), self._total()
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
        self.done[stage.name] = [future.result() for future in futures]
        self.peak_memory_mib = max(self.peak_memory_mib, process.peak_memory_mib)
        self._keep(stage.name)

    def _in_order(self, subjects: Sequence[str]) -> list[Answers]:
        assert self.description is not None
        out = []
        known = {(one.trial.subject, one.trial.shot, one.trial.seed): one for some in self.done.values()
                 for one in some}
        for run in self.seeds:
            same_as = first_run(self.task.protocol, run, self.seeds, seeded=self.description.seeded)
            for subject in subjects:
                for label in self.task.protocol.labels:
                    one = known.get((subject, label, run))
                    if one is None:  # the same support set, after the same training, as at the first of its runs
                        same = known[subject, label, same_as]
                        trial = Trial(subject, label, run, same.trial.support)
                        one = Answers(trial, same.readings, same.readings_std, same.mean, same.std, same.column_mean,
                                      same.pose, 0.0, 0.0)
                    out.append(one)
        return out

    # ------------------------------------------------------------------ interruption

    def _take_up(self, description: Description) -> None:
        """Read the stages that an earlier run of the same evaluation kept."""
        if self.part is None:
            return
        made = {"task": self.task.sha256, "dataset": self.dataset.sha256, "method": self.name,
                "entry": description.entry, "parameters": dict(description.parameters),
                "package": [description.package, description.version], "sandbox": self.isolation.sandbox,
                "contents": self.contents,
                **({"training": self.training.table()} if self.training.table() else {}),
                "shots": list(self.task.protocol.labels),
                **({"runs": len(self.seeds)} if self.task.protocol.folds else {})}
        self._key = json.dumps(made, sort_keys=True).encode()
        if (self.part / NOTE).is_file() and (self.part / NOTE).read_bytes() != self._key:
            self._tell_what_differs(made)
        elif (self.part / NOTE).is_file():
            for stage in self._stages:
                found = load(self.part / f"{stage.name}.npz")
                if found is not None:
                    self.done[stage.name] = found
                    self._recall(stage.name)
            if self.done and not self.task.protocol.folds and self._stages[0].name not in self.done:
                self.done.clear()  # the shots that are the same for every seed are in the first

    def _tell_what_differs(self, made: dict[str, Any]) -> None:
        """Say why stages that were kept are made again."""
        assert self.part is not None
        finished = len(list(self.part.glob("*.npz")))
        try:
            before = from_json((self.part / NOTE).read_bytes())
            odd = [key for key in made if key != "contents" and before.get(key) != made[key]]
            why = [*(f"the {key} is another one" for key in odd),
                   *differences(before.get("contents", {}), self.contents)]
        except (OSError, ValueError, TypeError, AttributeError):
            why = [f"{NOTE} cannot be read"]
        if finished:
            self.notes.append(f"{finished} finished {self._unit}{'s' * (finished > 1)} of an earlier run "
                              f"{'are' if finished > 1 else 'is'} not used, because {'; '.join(why)}")

    def _keep(self, stage: str) -> None:
        """Put the answers of a finished stage on disk; the folder is made with the first of them."""
        if self.part is None:
            return
        try:
            if not self.part.is_dir() or (self.part / NOTE).read_bytes() != self._key:
                shutil.rmtree(self.part, ignore_errors=True)
                self.part.mkdir(parents=True)
                write_atomic(self.part / NOTE, self._key, error=MethodError)
        except OSError as error:
            raise MethodError(f"folder {self.part} cannot be made: {error.strerror}. Choose another --out.") from error
        cost = {"meta_fit_s": self.meta_fit_s - self._told[0], "fits": self.fits - self._told[1],
                "peak_memory_mib": self.peak_memory_mib}
        self._told = self.meta_fit_s, self.fits
        write_atomic(self.part / f"{stage}.json", json.dumps(cost).encode(), error=MethodError)
        try:
            save(self.part / f"{stage}.npz", self.done[stage])
        except MethodError:  # no half of a stage stays behind
            (self.part / f"{stage}.json").unlink(missing_ok=True)
            raise

    def _recall(self, stage: str) -> None:
        """Add what a kept stage has cost."""
        assert self.part is not None
        try:
            cost = from_json((self.part / f"{stage}.json").read_text())
            self.meta_fit_s += float(cost["meta_fit_s"])
            self.fits += int(cost["fits"])
            self.peak_memory_mib = max(self.peak_memory_mib, float(cost["peak_memory_mib"]))
        except (OSError, ValueError, KeyError, TypeError):
            return  # of an older version, which kept no costs
        self._told = self.meta_fit_s, self.fits

    def _how_to_go_on(self) -> str:
        if self.part is None or not self.done:
            return f"interrupted; no {self._unit} was finished, so nothing is kept."
        return (f"interrupted; {len(self.done)} of {len(self._stages)} {self._unit}s are finished and kept in "
                f"{self.part}. Run the same command again to go on, or delete that folder to start again.")


def gather(path: Path) -> str:
    """Move the answers that jobs kept beside a result into the folder where an evaluation takes them up.

    Args:
        path: of the result.

    Returns:
        What the methods printed in these jobs.
    """
    parts, part = path.with_suffix(".parts"), path.with_suffix(".part")
    if not parts.is_dir():
        return ""
    printed = []
    for log in sorted(parts.glob("*.log")):
        text = log.read_text(errors="replace")
        printed += [text] if text.strip() else []
    for note in sorted(parts.glob(f"*/{NOTE}")):
        if (part / NOTE).is_file() and (part / NOTE).read_bytes() != note.read_bytes():
            shutil.rmtree(part)  # of other operands; the evaluation decides which are its own
        part.mkdir(parents=True, exist_ok=True)
        for file in sorted(note.parent.iterdir()):
            shutil.move(file, part / file.name)
    shutil.rmtree(parts, ignore_errors=True)
    return "".join(printed)
