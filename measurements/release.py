"""`vsfsim lab release`: makes every row, audit and study of the tasks in `leaderboard/release.toml`, and ships them
with the list of what made each row (`leaderboard/evidence.json`).

What ships already, and is of the present task, dataset, method, settings and scorer, is kept, and so is what lies in
`results`: the same command goes on after an interruption, and on another machine that is given `leaderboard` and
`tasks/records`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from measurements import audit
from papers.results import make_missing, stored
from papers.study import Study, Variant, load_study
from vsfsim.bench.admission import fingerprint
from vsfsim.bench.admission.admit import differences
from vsfsim.bench.board import rows as board
from vsfsim.bench.board.rows import LIST, Entry, Part, as_shipped, command_of, is_same, listed, plan, row_sha256
from vsfsim.bench.commands.catalogue import Choice, preset
from vsfsim.bench.evaluate import evaluate_all, is_of
from vsfsim.bench.identity import changed, method_sha256
from vsfsim.bench.leaderboard import Board, collect
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import write_record
from vsfsim.bench.task import Task, load_task, one_of, open_dataset
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError, VsfsimError
from vsfsim.core.text_table import text_table
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.data.provenance import VARIABLE, commit

MADE = Path("results")
SEEDS = (101, 102, 103)
"""Of the fresh datasets of an audit."""
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Whole:
    """What a release makes of one task, and what of it is there."""

    name: str
    """Of the task."""
    part: Part
    """Of the plan."""

    @property
    def task(self) -> Task:
        """The task."""
        return load_task(self.name)

    def choice(self, key: str) -> Choice:
        """The method and settings of a row."""
        method, _, settings = key.partition(".")
        return preset(method, settings, self.task.observation.name, self.task.metric.answer.value)

    def current(self, key: str) -> str:
        """The sha256 of a row that ships, is listed, and is what would be made here; else ""."""
        path, record = shelf.folder("leaderboard") / self.name / f"{key}.json", fingerprint.shipped_record(self.task)
        if not path.is_file() or record is None:
            return ""
        row = Result.load(path)
        entry = listed().get(sha256 := row_sha256(row))
        same = entry is not None and is_of(row, self.task, self.choice(key)) and (
            entry.other_bits or row.dataset_sha256 == record.dataset_sha256)
        return sha256 if same and not changed(row.method, row.parameters, row.contents) else ""

    def audited(self) -> str:
        """Digest of what an audit is made of: the dataset, the shortcuts, the fresh seeds, and the rows of the methods
        that are made again on them; the other rows are read where the audit is printed."""
        record = fingerprint.shipped_record(self.task)
        again = [key for key in self.part.fresh if key != "dataset"]
        of = [self.task.sha256, record.dataset_sha256 if record is not None else "", method_sha256(audit.METHOD),
              *map(self.current, again), *again, *map(str, SEEDS)]
        return hashlib.sha256(" ".join(of).encode()).hexdigest()

    def items(self) -> dict[str, tuple[float, bool]]:
        """CPU minutes of everything, and whether it is there."""
        there = {key: (minutes, bool(self.current(key))) for key, minutes in self.part.rows.items()}
        if self.part.audit:
            done = audit.shipped(self.task).of == self.audited() and all(done for _, done in there.values())
            there["audit"] = (self.part.audit + len(SEEDS) * sum(self.part.fresh.values()), done)
        there |= {f"study {name}": (minutes, not lacking(load_study(name)))
                  for name, minutes in self.part.studies.items()}
        made = (self.task.dataset.path() / "dataset.json").is_file()
        return {"dataset": (self.part.dataset, made or all(done for _, done in there.values()))} | there

    def make(self, workers: int, progress: Progress) -> Iterator[tuple[str, str]]:
        """Make and ship what is missing; yields what is there now, and "" or why it could not be made."""
        left = [key for key, (_, done) in self.items().items() if not done]
        task, out = self.task, shelf.checkout() / "leaderboard"
        if not left or (task.dataset.recorded and "dataset" in left):
            return
        try:
            data = dataset_of(task, workers)
        except TaskError as error:  # what lies there is another one
            yield "dataset", str(error)
            return
        _keep_record(task, data, out)
        for key in self.part.rows:
            if not self.current(key):
                path, began = MADE / self.name / f"{key}.json", sum(os.times()[:4])
                (made,) = evaluate_all(task, {path: self.choice(key)}, dataset=data, workers=workers, progress=progress)
                if made.failure is None:
                    (row,) = collect(task, [path], shipped=False).rows
                    ship({Path(self.name, path.name): (row.admitted(), "", sum(os.times()[:4]) - began)}, out)
                yield key, str(made.failure or "")
        if "audit" in left and all(map(self.current, self.part.rows)):
            try:
                folders = [self._on(seed, workers, progress) for seed in SEEDS] if self.part.fresh else []
                found = audit.audit(task, [], dataset=data.path, fresh=folders, workers=workers,
                                    progress=progress)
                ship_audit(found, out / "audits" / f"{self.name}.json", task.sha256, self.audited())
                yield "audit", ""
            except VsfsimError as error:  # studies and other tasks are made all the same
                yield "audit", str(error)
        yield from make_studies([one for one in map(load_study, self.part.studies) if lacking(one)], out, workers,
                                progress)

    def _on(self, seed: int, workers: int, progress: Progress) -> Path:
        """Rows on objects of another seed, for the audit: their folder."""
        task = self.task.on(f"seed-{seed}")
        rows = {MADE / task.name / f"{key}.json": self.choice(key) for key in self.part.fresh if key != "dataset"}
        for made in evaluate_all(task, rows, dataset=dataset_of(task, workers), workers=workers, progress=progress):
            if made.failure is not None:
                raise made.failure
        return MADE / task.name


def _keep_record(task: Task, data: Dataset, out: Path) -> None:
    """Write the record of a task's data if there is none of it, and remove the rows of other data."""
    record = fingerprint.shipped_record(task)
    if record is not None and record.dataset_sha256 == data.sha256:
        return
    new, path = fingerprint.make_record(task, data), fingerprint.record_path(task)
    if record is not None and not differences(new, record):
        # the same data, made on a machine that rounds otherwise, or by code that marks other frames
        write_record(path, msgspec.structs.replace(record, unresolved=new.unresolved))
        return
    write_record(path, msgspec.structs.replace(new, again=record.again if record is not None else 0.0))
    for path in [*(out / task.name).glob("*.json"), *(out / "studies" / task.name).glob("*.json")]:
        path.unlink()
    write_list([entry for entry in listed().values() if entry.task != task.name], out / LIST)


def planned(only: Sequence[str] | None) -> tuple[str, list[list[str]]]:
    """What a release makes of some tasks or of all: a table with its CPU minutes and whether it is there, and for JSON.

    Raises:
        TaskError: there is no such task in the table, or it is damaged.
    """
    asked = _asked(only)
    found = [(one.name, what, minutes, done) for one in asked for what, (minutes, done) in one.items().items()]
    rows = [[task, what, f"{minutes:g}", "there" if done else "missing"] for task, what, minutes, done in found]
    hours = [sum(minutes for *_, minutes, done in found if not (done and left)) / 60.0 for left in (False, True)]
    table = text_table(["task", "what", "CPU min", "state"], rows)
    said = [f"{hours[0]:.1f} CPU hours, of which {hours[1]:.1f} are missing", *left_out(asked)]
    return "\n".join([table, *said]), rows


def release(only: Sequence[str] | None, workers: int, progress: Progress) -> tuple[str, list[str]]:
    """Make and ship what a release makes of some tasks, or of all, and is not there.

    Args:
        only: names of the tasks, None for all. workers: trainings and trials at a time. progress: as of
        `vsfsim.bench.evaluate.evaluate`.

    Returns:
        What was left out and the next step, to be printed, and what was made.

    Raises:
        TaskError: something could not be made, and the rest is there; or the code here names no commit.
    """
    if commit() is None:
        raise TaskError(f"The code here names no commit, which every row that ships has. Set {VARIABLE} to what "
                        f"`python -m vsfsim.data.provenance` prints in the checkout that it was copied from.")
    asked = _asked(only)
    found = {f"{one.name}, {what}": message for one in asked for what, message in one.make(workers, progress)}
    if any(found.values()):
        raise TaskError("\n\n".join(f"{what}: {message}" for what, message in found.items() if message))
    return "\n".join([*left_out(asked), "python docs/make.py results   # writes the pages' tables"]), list(found)


def _asked(only: Sequence[str] | None) -> list[Whole]:
    known = plan()
    return [Whole(name, known[name]) for name in [one_of(name, known, "--only") for name in only or ()] or known]


def left_out(asked: Sequence[Whole]) -> list[str]:
    """What is not made here, each with the reason: tasks whose recordings do not ship, and variants of a study in
    `leaderboard/absent.toml`."""
    gone = [one.task for one in asked if one.task.dataset.recorded and not one.items()["dataset"][1]]
    return [*(f"left out: {task.name}; its recordings do not ship, and are not in {task.dataset.path()}"
              for task in gone),
            *(f"left out of study {name}: {what}; {why}" for one in asked for name in one.part.studies
              for what, why in board.absent(f"study {name}", ()).items())]


def lacking(study: Study, boards: dict[str, Board] | None = None, *, made: bool = False) -> list[Variant]:
    """The variants of a study that have no result that ships and counts, and are not in `leaderboard/absent.toml`;
    operands as of `papers.results.stored`."""
    there = {*stored(study, boards, made), *", ".join(board.absent(f"study {study.name}", ())).split(", ")}
    return [variant for variant in study.variants if variant.name not in there]


def make_studies(studies: Sequence[Study], out: Path, workers: int, progress: Progress) -> Iterator[tuple[str, str]]:
    """Make what some studies lack, datasets too, and ship it; yields as `papers.results.make_missing`."""
    boards = dict[str, Board]()
    asked = [dataclasses.replace(one, variants=tuple(lacking(one, boards, made=True))) for one in studies]
    for task in [one.task_of(variant) for one in asked for variant in one.variants]:
        dataset_of(task, workers)
    yield from make_missing(asked, workers, progress)
    ship({one.path.relative_to(MADE): (one.result, f"vsfsim papers study {study.name}", 0.0) for study in studies
          for one in stored(study).values() if MADE / "studies" in one.path.parents}, out)


def dataset_of(task: Task, workers: int) -> Dataset:
    """The task's dataset, made if it is not there and of a scene."""
    if not task.dataset.recorded and not (task.dataset.path() / "dataset.json").is_file():
        subprocess.run([sys.executable, "-m", *shlex.split(task.dataset.command()), "--workers", str(workers)],
                       check=True)
    return open_dataset(task)


def ship(rows: Mapping[Path, tuple[Result, str, float]], out: Path) -> None:
    """Write results as rows that ship, and what made them into the list beside them. A row that comes out again, to the
    same numbers, becomes "verified".

    Args:
        rows: by the place below ``out``, the result, the command that made it ("" for that of `vsfsim evaluate`), and
            its CPU seconds, which are at least those in the method's calls.
        out: the folder of the rows that ship.

    Raises:
        TaskError: a file cannot be written.
    """
    entries = listed()
    for place, (given, command, seconds) in rows.items():
        row, target = as_shipped(given), out / place
        before = Result.load(target) if target.is_file() else row
        sha256, entry = row_sha256(row), entries.pop(row_sha256(before), None)
        if entry is None or entry.sha256 != sha256:
            spent = max(seconds, sum(row.timing.get(key, 0.0) for key in ("meta_fit_s", "adapt_s", "predict_s")))
            entry = Entry(sha256, row.task, row.method, "verified" if entry and is_same(row, before) else "open",
                          command or command_of(row, whole=not row.preset), row.made_by.get("commit") or "",
                          row.machine.get("cpu") or "", round(spent, 1), bool(given.data))
        row.save(target)
        entries[sha256] = entry
    write_list(entries.values(), out / LIST)


def write_list(entries: Iterable[Entry], path: Path) -> None:
    """Write the list, an entry a line.

    Raises:
        TaskError: the file cannot be written.
    """
    order = sorted(entries, key=lambda e: (e.task, e.method, e.sha256))
    lines = ",\n".join(msgspec.json.encode(entry).decode() for entry in order)
    write_atomic(path, f"[\n{lines}\n]\n".encode(), error=TaskError)


def ship_audit(found: audit.Audit, path: Path, task_sha256: str, of: str = "") -> None:
    """Write what of an audit needs data or further rows.

    Args:
        found: the audit. path: of the file. task_sha256: of the task. of: digest of what it was made of.

    Raises:
        TaskError: the file cannot be written.
    """
    errors = {sees: {name: float(f"{value:.7g}") for name, value in of.items()} for sees, of in found.errors.items()}
    write_record(path, audit.Shipped("vsfsim-audit-2", task_sha256, of, found.fresh, errors))
