"""The results of a study's variants: where they lie, whether they are what is asked, and how they are made."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from papers.study import Study, Variant
from vsfsim.bench import leaderboard
from vsfsim.bench.board.compare import ByObject, by_object
from vsfsim.bench.board.rows import EARLIER, SAME_READINGS, listed, read_rows, row_sha256, write_rows
from vsfsim.bench.commands.catalogue import on_device
from vsfsim.bench.evaluate import make
from vsfsim.bench.result import Result, readings_apart
from vsfsim.bench.task import Protocol, Task, load_task
from vsfsim.bench.trials.jobs import Evaluation
from vsfsim.bench.trials.training import models_of
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shelf import folder, scenes
from vsfsim.core.system.engines import HERE, Fan

MADE = Path("results")


@dataclass(frozen=True)
class Found:
    """The result of a variant."""

    variant: Variant
    """The variant."""
    result: Result
    """Its result."""
    path: Path
    """Its file."""
    protocol: Protocol
    """Of its task, with the study's shots and runs."""
    objects: frozenset[str] | None = None
    """Names of the objects that count, None for all."""
    stands: bool = True
    """It is no earlier row (`vsfsim.bench.board.rows.EARLIER`), on which no claim rests."""

    def values(self, metric: str, shot: str) -> ByObject:
        """A metric of each object that counts, mean over runs; {} where the result does not hold it."""
        found = by_object(self.result, metric, shot)
        return {name: v for name, v in found.items() if self.objects is None or name in self.objects}


def stored(study: Study, size: str, variants: Sequence[Variant] | None = None,
           boards: dict[str, leaderboard.Board] | None = None, made: bool = True) -> dict[str, Found]:
    """The variants that have a result, made here or shipped, by name.

    A row of the task's leaderboard serves where a variant is one. A result of another version of the task, or of other
    settings, does not count.

    Args:
        study: the study. size: of its tasks; {} for one that it does not have. variants: of it, None for all. boards:
        by name of the task, those that are read already; others are added. made: results made here count; else only
        those that ship.

    Raises:
        TaskError: a file is damaged; a table that the study needs is missing.
    """
    out = {}
    boards = {} if boards is None else boards
    read = functools.cache(read_rows)
    for variant in variants if variants is not None else study.variants:
        if not study.has(variant, size):
            continue
        task = study.task_of(variant, size)
        if study.is_row(variant):
            known = [(row.path, row.result, row.rank is not None) for row in board_of(task.name, boards, made).rows
                     if (row.rank is not None or row.mark == EARLIER)
                     and (row.result.method, row.result.preset) == (variant.method, variant.preset)]
        else:
            known = [(path, result, of == MADE or row_sha256(result) in listed())
                     for of in [MADE] * made + [folder("leaderboard")]
                     for path, result in _of_study(of / "studies", task.name, f"{study.stem(variant)}.json", read)
                     if result.task_sha256 == task.sha256 and result.shots == task.protocol.labels]
        if known:
            path, result, stands = known[0]
            out[variant.name] = Found(variant, result, path, task.protocol, _counted(study, variant, task), stands)
    return out


def _of_study(of: Path, task: str, name: str, read: Callable[[Path], dict[str, Result]]) -> list[tuple[Path, Result]]:
    """The result of a name in a folder of studies: a file made here, or a row that ships."""
    path = of / task / name
    if path.is_file():
        return [(path, Result.load(path))]
    return [(path, result) for key, result in read(of / f"{task}.json").items() if key == name]


def ship(task: str, out: Path) -> None:
    """Write the results that studies of a task have made here, beside those that ship, as the file that ships.

    Args:
        task: its name. out: the file.

    Raises:
        TaskError: a file is damaged or cannot be written.
    """
    rows = read_rows(folder("leaderboard") / "studies" / f"{task}.json")
    rows |= {path.name: Result.load(path) for path in (MADE / "studies" / task).glob("*.json")}
    if rows:
        write_rows(dict(sorted(rows.items())), out)


def board_of(task: str, boards: dict[str, leaderboard.Board], made: bool = True) -> leaderboard.Board:
    """The leaderboard of a task, read once.

    Args:
        task: its name. boards, made: as of `stored`.

    Raises:
        TaskError: there is no such task; a file is damaged.
    """
    if task not in boards:
        here = MADE / task
        boards[task] = leaderboard.collect(load_task(task), [here] if made and here.is_dir() else [])
    return boards[task]


def _counted(study: Study, variant: Variant, task: Task) -> frozenset[str] | None:
    """Names of the objects of the variant's class."""
    if not variant.only:
        return None
    models = models_of(scenes()[task.dataset.scene].read_text(encoding="utf-8"))
    return frozenset(f"{task.dataset.scene}-{k:04d}" for k in range(task.dataset.objects)
                     if models and study.class_of.get(models[k % len(models)]) == variant.only)


def evaluation(study: Study, variant: Variant, size: str, device: str = "") -> Evaluation:
    """What makes the result of a variant.

    Args:
        study: the study. variant: of it. size: of its tasks. device: that methods use which a GPU makes faster.

    Raises:
        VsfsimError: the dataset is missing, with the command that makes it, or does not fit.
    """
    task = study.task_of(variant, size)
    if study.is_row(variant):
        task = load_task(task.name)  # without the study's shots and runs
    choice = on_device(study.choice(variant, task), device, task.observation.name)
    path = MADE / task.name / f"{choice.stem}.json" if study.is_row(variant) else (
        MADE / "studies" / task.name / f"{study.stem(variant)}.json")
    return Evaluation(choice.method, task, study.dataset_of(variant, task), path, choice.parameters,
                      preset=choice.preset, training=study.training(variant, task, size))


def make_missing(studies: Sequence[Study], size: str, processes: int,
                 progress: Callable[[int, int, str], None] = lambda *_: None, device: str = "",
                 fan: Fan = HERE) -> Iterator[tuple[str, str]]:
    """Make the results of some studies that are not there, several trainings at a time.

    Args:
        studies: whose variants are made. size: of the tasks. processes: trainings at a time. progress: called with
        (done, of how many, what is going on). device: as of `evaluation`. fan: where the trainings run; a shard scores
        nothing.

    Yields:
        "study, variant" and "" or the message of a failure, as they are ready.

    Raises:
        Interrupted: the user has stopped it.
    """
    jobs, boards = dict[Path, tuple[str, Evaluation]](), dict[str, leaderboard.Board]()
    for study in studies:
        found = stored(study, size, boards=boards)
        for variant in study.variants:
            name = f"{study.name}, {variant.name}"
            if not study.has(variant, size) or (variant.name in found and found[variant.name].stands):
                continue
            try:
                one = evaluation(study, variant, size, device)
            except VsfsimError as error:
                yield name, str(error)
                continue
            jobs.setdefault(one.path, (name, one))
    for made in make([one for _, one in jobs.values()], processes, check=False, fan=fan, progress=progress):
        yield jobs[made.path][0], str(made.failure or "")


def on_other_data(found: Mapping[str, Found]) -> list[str]:
    """Variants of the same query touches as the first one with other readings, by more than the same dataset differs by
    when it is made again on a machine that rounds otherwise.

    Args:
        found: results by variant.
    """
    first = next(iter(found.values()), None)
    apart = {name: readings_apart(one.result.readings, first.result.readings) for name, one in found.items()
             } if first is not None else {}
    return [name for name, difference in apart.items() if difference is not None and difference > SAME_READINGS]
