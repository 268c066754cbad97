"""Run a method through a task and score it. The same code for our baselines and for everybody else's method.

The method runs in a process of its own (`vsfsim.bench.isolation`), a fresh copy of what it learned in every trial
(`vsfsim.bench.trials.collect`). Only when all its answers are there, the truth is read and the answers are scored
(`vsfsim.bench.trials.score`).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.curves import Curves
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.method import check_name
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.answers import Answers
from vsfsim.bench.trials.collect import Collector, Progress, gather
from vsfsim.bench.trials.score import map_of, result_of
from vsfsim.bench.trials.training import PLAIN, Training
from vsfsim.data.dataset import Dataset


def evaluate(name: str, task: Task, dataset: Dataset, *, parameters: Mapping[str, Any] | None = None,
             seeds: int | None = None, progress: Progress | None = None, isolation: Isolation | None = None,
             part: str | Path | None = None, log: str | Path | None = None, check: bool = True,
             preset: str = "", training: Training = PLAIN, curves: Path | None = None) -> Result:
    """Score a method.

    Args:
        name: an installed method, or module:attribute. Its module is imported in another process only.
        task: the task.
        dataset: as `open_dataset` returns it.
        parameters: of the method's constructor, over its defaults.
        seeds: draws of the support set, or None for the task's own number; with cross-validation, of one training.
        progress: called with (trials done, of how many, what is going on).
        isolation: how the method is kept from what it may not see, and for how long it may run; None for the strongest
        sandbox that works here.
        part: folder in which finished seeds are kept. A second call with the same operands begins where the first one
            was stopped. It is removed when all is done; None keeps nothing.
        log: file to which everything goes that the method prints; None for a temporary one.
        preset: name of the settings, for the leaderboard; they are in ``parameters`` already.
        check: test on mock objects first whether the method keeps its contract.
        training: what the method learns from, where a study departs from the task (`vsfsim study`). Such a result is
            never ranked.
        curves: file for all predictions beside the truth (`vsfsim.bench.curves.Curves`); None writes none.

    Raises:
        MethodError: the method is unknown, breaks its contract, raises, takes too long, or answers with something that
            cannot be scored.
        TaskError: the dataset has too few touches.
        Interrupted: the user has stopped it.
    """
    check_name(name)
    isolation = isolation or Isolation()
    data = {} if training.table() else fingerprint.beside_record(task, dataset)
    with tempfile.TemporaryDirectory() as folder:
        run = Collector(name, dict(parameters or {}), task, dataset,
                        seeds, isolation,
                        Path(folder) / "log" if log is None else Path(log).absolute(),
                        None if part is None else Path(part).absolute(), progress or (lambda *_: None), check,
                        training)
        answers = run.run()
    if curves is not None:
        Curves.of(answers, task, dataset, run.seeds).save(curves)
    said = run.description
    assert said is not None
    timing = {"meta_fit_s": run.meta_fit_s, "fits": run.fits, "adapt_s": sum(a.adapt_s for a in answers),
              "predict_s": sum(a.predict_s for a in answers), "adapts": sum(a.adapt_s > 0.0 for a in answers),
              "predicts": sum(len(a.readings) for a in answers if a.adapt_s > 0.0)}
    notes = [*run.notes, *([f"superseded by {task.superseded_by}"] if task.superseded_by else [])]
    wanted = len(task.protocol.runs(seeded=said.seeded))
    if len(run.seeds) != wanted:
        notes.append(f"{len(run.seeds)} seeds instead of the task's {wanted}")
    return result_of(answers, task, dataset, run.seeds, method=name, entry=said.entry, parameters=dict(said.parameters),
                     timing=timing, peak_memory_mib=round(run.peak_memory_mib, 1), notes=tuple(notes),
                     package={"name": said.package, "version": said.version}, isolation=isolation.sandbox,
                     contents=run.contents, data=data, preset=preset, study=training.table(),
                     maps={} if training.table() else _maps(answers, task, dataset))


def finish(name: str, task: Task, dataset: Dataset, path: Path, **options: Any) -> Result:
    """Evaluate with what was kept beside the result, write it, and remove what was kept.

    Args:
        name, task, dataset: as of `evaluate`. path: of the result. options: further ones.
    """
    part, log = path.with_suffix(".part"), log_of(path)
    log.unlink(missing_ok=True)
    before = gather(path)
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / "log"
        result = evaluate(name, task, dataset, part=part, log=printed, **options)
        result.save(path)
        shutil.rmtree(part, ignore_errors=True)
        text = before + (printed.read_text(errors="replace") if printed.is_file() else "")
        if text:
            log.write_text(text)
    return result


def log_of(result: Path) -> Path:
    """The file beside a result that holds what the method printed: RESULT.json.log, as RESULT.log may be the user's."""
    return result.with_name(result.name + ".log")


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
