"""Run a method through a task and score it. The same code for our baselines and for everybody else's method.

The method runs in processes of its own (`vsfsim.bench.isolation`), a fresh copy of what it learned in every trial
(`vsfsim.bench.trials.jobs`). Only when all its answers are there, the truth is read and the answers are scored
(`vsfsim.bench.trials.score`).
"""

from __future__ import annotations

import functools
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.curves import Curves
from vsfsim.bench.identity import versions_of
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result, versions
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Answers, Reader
from vsfsim.bench.trials.jobs import Evaluation, Progress
from vsfsim.bench.trials.score import map_of, result_of
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.core.errors import Interrupted
from vsfsim.core.system.content import file_sha256
from vsfsim.data.dataset import Dataset


@dataclass(frozen=True)
class Row:
    """A result that is to be made: an evaluation and its file."""

    path: Path
    """The file."""
    of: Evaluation
    """The evaluation; its answers are kept beside the file until all are there."""
    preset: str = ""
    """Name of the settings, for the leaderboard; they are in the evaluation's parameters already."""
    curves: Path | None = None
    """File for all predictions beside the truth (`vsfsim.bench.curves.Curves`), or None."""
    after: Callable[[Result], Result] = lambda result: result
    """What becomes of the result before it is written."""

    @classmethod
    def at(cls, path: Path, name: str, task: Task, dataset: Dataset, *, parameters: Mapping[str, Any] | None = None,
           seeds: int | None = None, isolation: Isolation | None = None, training: Training = PLAIN,
           **more: Any) -> Row:
        """A row at ``path``; operands as of `evaluate`, and further fields."""
        parts = path.with_suffix(".parts").absolute()
        return cls(path, Evaluation(name, task, dataset, parts, dict(parameters or {}), seeds,
                                    isolation or Isolation(), training), **more)

    def finish(self) -> Result:
        """Score the kept answers, write the result and what the method printed, and remove what was kept.

        Raises:
            MethodError: an answer is missing.
        """
        result = self.after(_scored(self.of, self.preset, self.curves))
        result.save(self.path)
        log_of(self.path).unlink(missing_ok=True)
        if text := self.printed():
            log_of(self.path).write_text(text)
        shutil.rmtree(self.of.parts, ignore_errors=True)
        return result

    def printed(self) -> str:
        """What the method printed in all its jobs."""
        return "".join(log.read_text(errors="replace") for log in sorted(self.of.parts.glob("*.log")))


def evaluate(name: str, task: Task, dataset: Dataset, *, log: str | Path | None = None, **options: Any) -> Result:
    """Score a method.

    Args:
        name: an installed method, or module:attribute. Its module is imported in another process only.
        task: the task.
        dataset: as `open_dataset` returns it.
        log: file to which everything goes that the method prints; None for none.
        options: of `finish`.

    Raises:
        MethodError: the method is unknown, breaks its contract, raises, takes too long, or answers with something that
            cannot be scored.
        TaskError: the dataset has too few touches.
        Interrupted: the user has stopped it.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        result = finish(name, task, dataset, path, **options)
        if log is not None:
            Path(log).write_text(log_of(path).read_text() if log_of(path).is_file() else "")
        return result


def finish(name: str, task: Task, dataset: Dataset, path: Path, *, check: bool = True,
           progress: Progress | None = None, **options: Any) -> Result:
    """Score a method and write the result. Finished trainings are kept beside it, and a second call with the same
    operands goes on with them.

    Args:
        name, task, dataset: as of `evaluate`. path: of the result.
        check: test on mock objects first whether the method keeps its contract.
        progress: called with (trials done, of how many, what is going on).
        options: ``parameters`` of the method's constructor, over its defaults; ``seeds``, draws of the support set,
            None for the task's own number; with cross-validation, of one training; ``isolation``, how the method is
            kept from what it may not see, None for the strongest sandbox that works here; ``preset``, name of the
            settings, for the leaderboard; they are in ``parameters`` already; ``training``, what the method learns
            from, where a study departs from the task (`vsfsim study`): such a result is never ranked; ``curves``,
            file for all predictions beside the truth (`vsfsim.bench.curves.Curves`).

    Raises:
        As `evaluate`.
    """
    check_name(name)
    row, tell = Row.at(path, name, task, dataset, **options), progress or (lambda *_: None)
    one, reader = row.of, Reader()
    try:
        with one:
            tell(0, 1, "contract")
            one.look(check=check)
            sizes = {job.name: len(job.asked(task.protocol.labels)) for job in one.jobs}
            left = one.left
            before, total = sum(sizes.values()) - sum(sizes[job.name] for job in left), sum(sizes.values())
            one.read(left, reader)
            for job in left:
                one.make(job, reader, functools.partial(_tell, tell, before, total))
                before += sizes[job.name]
    except KeyboardInterrupt as stop:
        made = len(one.jobs) - len(one.left) if one.description is not None else 0
        raise Interrupted("interrupted; no training was finished, so nothing is kept." if not made else
                          f"interrupted; {made} of {len(one.jobs)} trainings are finished and kept in {one.parts}. Run "
                          f"the same command again to go on, or delete that folder to start again.") from stop
    return row.finish()


def _tell(tell: Progress, before: int, total: int, done: int, _: int, what: str) -> None:
    tell(before + done, total, what)


def log_of(result: Path) -> Path:
    """The file beside a result that holds what the method printed: RESULT.json.log, as RESULT.log may be the user's."""
    return result.with_name(result.name + ".log")


def _scored(one: Evaluation, preset: str, curves: Path | None) -> Result:
    """The result of an evaluation whose jobs are all kept."""
    answers, done = one.answers()
    said, task, dataset, plain = one.said, one.task, one.dataset, not one.training.table()
    if curves is not None:
        Curves.of(answers, task, dataset, one.runs).save(curves)
    timing = {"meta_fit_s": sum(job.meta_fit_s for job in done), "fits": len(done),
              "adapt_s": sum(a.adapt_s for a in answers), "predict_s": sum(a.predict_s for a in answers),
              "adapts": sum(a.adapt_s > 0.0 for a in answers),
              "predicts": sum(len(a.readings) for a in answers if a.adapt_s > 0.0)}
    notes = [*one.notes, *([f"superseded by {task.superseded_by}"] if task.superseded_by else [])]
    wanted = len(task.protocol.runs(seeded=said.seeded))
    if len(one.runs) != wanted:
        notes.append(f"{len(one.runs)} seeds instead of the task's {wanted}")
    opened = {name: file_sha256(Path(name)) for job in done for name in job.opened}
    return result_of(answers, task, dataset, one.runs, method=one.method, entry=said.entry,
                     parameters=dict(said.parameters), timing=timing,
                     peak_memory_mib=round(max(job.peak_memory_mib for job in done), 1), notes=tuple(notes),
                     package={"name": said.package, "version": said.version}, isolation=one.isolation.sandbox,
                     contents={**one.contents, **opened}, preset=preset,
                     data=fingerprint.beside_record(task, dataset) if plain else {},
                     study=one.training.table(), versions={**versions_of(one.method), **versions()},
                     maps=_maps(answers, task, dataset) if plain else {})


def _maps(answers: list[Answers], task: Task, dataset: Dataset) -> dict[str, list]:
    """`Result.maps` of a task with cross-validation: of the first run at the shot that ranks, and of the first view of
    each object, because all of them would be most of a result file."""
    out: dict[str, list] = {}
    shown = {e.name for e in dataset.entries if e.view_index == 0}
    first = [a for a in answers if (a.trial.shot, a.trial.seed) == (task.ranking_shot, 0) and a.mean is not None
             and a.trial.subject in shown]
    for given in first if task.protocol.folds else ():
        for column, values in map_of(given, dataset).items():
            out.setdefault(column, []).extend(values)
    return out
