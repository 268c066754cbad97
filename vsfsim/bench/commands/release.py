"""`vsfsim lab release`: makes every row, audit and study of the tasks in `leaderboard/release.toml`, and ships them
with the list of what made each row (`leaderboard/evidence.json`).

What is there already, of the present task, dataset, method and settings, is kept: the same command goes on.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from vsfsim.bench.admission import fingerprint
from vsfsim.bench.board.rows import Part, plan
from vsfsim.bench.commands.catalogue import Choice, preset
from vsfsim.bench.evaluate import evaluate_all
from vsfsim.bench.leaderboard import collect, ship
from vsfsim.bench.task import Task, load_task, one_of, open_dataset
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError
from vsfsim.core.text_table import text_table
from vsfsim.data.dataset import Dataset
from vsfsim.data.provenance import VARIABLE, commit

MADE = Path("results")
Progress = Callable[[int, int, str], None]
Studies = Callable[[Sequence[str], Path, int, Progress], Iterator[tuple[str, str]]]


def planned(only: str | None) -> tuple[str, list[list[str]]]:
    """What a release makes of a task, or of all, as a table with its CPU minutes, and for JSON.

    Raises:
        TaskError: there is no such task in the table, or it is damaged.
    """
    rows = [[task, what, f"{minutes:g}"] for task, part in _asked(only).items() for what, minutes in {
        "dataset": part.dataset, **part.rows, "audit": part.audit,
        **{f"study {name}": minutes for name, minutes in part.studies.items()}}.items()]
    hours = sum(float(row[2]) for row in rows) / 60.0
    return f"{text_table(['task', 'what', 'CPU min'], rows)}\n{hours:.1f} CPU hours", rows


def release(only: str | None, workers: int, progress: Progress, studies: Studies, audit: Callable[..., Any]
            ) -> tuple[str, list[str]]:
    """Make and ship what a release makes of a task, or of all.

    Args:
        only: name of the task, None for all. workers: trainings and trials at a time. progress: as of
        `vsfsim.bench.evaluate.evaluate`. studies: makes and ships those of some names. audit:
        `vsfsim.bench.commands.audit.audit`.

    Returns:
        The next step, to be printed, and what is there now.

    Raises:
        TaskError: something could not be made, and the rest is there; or the code here names no commit.
    """
    if commit() is None:
        raise TaskError(f"The code here names no commit, which every row that ships has. Set {VARIABLE} to what "
                        f"`python -m vsfsim.data.provenance` prints in the checkout that it was copied from.")
    out = shelf.checkout() / "leaderboard"
    found = {f"{name}, {what}": message for name, part in _asked(only).items()
             for what, message in _make(name, part, out, workers, progress, studies, audit)}
    if any(found.values()):
        raise TaskError("\n\n".join(f"{what}: {message}" for what, message in found.items() if message))
    return "python docs/make_measured.py results   # writes the pages' tables", list(found)


def _asked(only: str | None) -> dict[str, Part]:
    return plan() if only is None else {one_of(only, plan(), "--only"): plan()[only]}


def _make(name: str, part: Part, out: Path, workers: int, progress: Progress, studies: Studies,
          audit: Callable[..., Any]) -> Iterator[tuple[str, str]]:
    """What is there now of a task, and "" or why it could not be made."""
    task, known, seconds = load_task(name), list[Path](), dict[str, float]()
    try:
        data = dataset_of(task, workers)
    except TaskError as error:  # recordings that nobody may ship are not everywhere
        yield "dataset", str(error)
        return
    record = fingerprint.shipped_record(task)
    if record is None or record.dataset_sha256 != data.sha256:  # the rows stand on the data of this machine
        new, again = fingerprint.make_record(task, data), record.again if record is not None else 0.0
        fingerprint.save_record(msgspec.structs.replace(new, again=again), fingerprint.record_path(task))
    for key in part.rows:
        method, _, settings = key.partition(".")
        row = preset(method, settings, task.observation.name, task.metric.answer.value) if settings else (
            Choice(method, "", {}))
        path, began = MADE / name / f"{key}.json", sum(os.times()[:4])
        (made,) = evaluate_all(task, {path: row}, dataset=data, workers=workers, progress=progress)
        known += [path] * (made.failure is None)
        seconds[path.name] = sum(os.times()[:4]) - began
        yield key, str(made.failure or "")
    ship({Path(name, row.path.name): (row.admitted(), "", seconds[row.path.name])
          for row in collect(task, known, shipped=False).rows}, out)
    if part.audit:
        audit(task, known, progress=progress).ship(out / "audits" / f"{name}.json", task.sha256)
        yield "audit", ""
    yield from studies(list(part.studies), out, workers, progress)


def dataset_of(task: Task, workers: int) -> Dataset:
    """The task's dataset, made if it is not there and of a scene."""
    if not task.dataset.recorded and not (task.dataset.path() / "dataset.json").is_file():
        subprocess.run([sys.executable, "-m", *shlex.split(task.dataset.command()), "--workers", str(workers)],
                       check=True)
    return open_dataset(task)
