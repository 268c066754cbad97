"""The results of a study's variants: where they lie, whether they are what is asked, and how they are made."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from papers.study import Study, Variant
from vsfsim.bench import leaderboard
from vsfsim.bench.board.compare import Runs, by_run
from vsfsim.bench.board.rows import listed, row_sha256
from vsfsim.bench.evaluate import make
from vsfsim.bench.identity import changed
from vsfsim.bench.result import Result
from vsfsim.bench.task import Protocol, load_task, open_dataset
from vsfsim.bench.trials.jobs import Evaluation
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shelf import folder

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

    def values(self, metric: str, shot: str) -> Runs:
        """A metric of each object in each run; {} where the result does not hold it."""
        return by_run(self.result, metric, shot, self.protocol.draws or len(self.result.seeds))


def stored(study: Study, boards: dict[str, leaderboard.Board] | None = None, made: bool = True) -> dict[str, Found]:
    """The variants that have a result, made here or shipped, by name.

    A ranked row of the task's leaderboard serves where a variant is one. A result counts if it is of the present task,
    settings, method and scorer (`vsfsim.bench.identity.changed`), and, of those that ship, on the repository's list.

    Args:
        study: the study. boards: by name of the task, those that are read already; others are added. made: results made
        here count; else only those that ship.

    Raises:
        TaskError: a file is damaged; a table that the study needs is missing.
    """
    out, boards = {}, {} if boards is None else boards
    for variant in study.variants:
        task = study.task_of(variant)
        if study.is_row(variant):
            known = [(row.path, row.result) for row in board_of(task.name, boards, made).rows if row.rank is not None
                     and (row.result.method, row.result.preset) == (variant.method, variant.preset)]
        else:
            files = [of / study.place(variant) for of in (*[MADE] * made, folder("leaderboard"))]
            known = [(path, result) for path, result in ((path, Result.load(path)) for path in files if path.is_file())
                     if (result.task_sha256, result.shots) == (task.sha256, task.protocol.labels)
                     and (MADE in path.parents or row_sha256(result) in listed())]
        known = [(path, r) for path, r in known if not changed(r.method, r.parameters, r.contents)]
        if known:
            path, result = known[0]
            out[variant.name] = Found(variant, result, path, task.protocol)
    return out


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


def make_missing(studies: Sequence[Study], processes: int, progress: Callable[[int, int, str], None] = lambda *_: None
                 ) -> Iterator[tuple[str, str]]:
    """Make the results of some studies that are not there, several trainings at a time.

    Args:
        studies: whose variants are made. processes: trainings at a time. progress: called with (done, of how many, what
        is going on).

    Yields:
        "study, variant" and "" or the message of a failure, as they are ready.

    Raises:
        Interrupted: the user has stopped it.
    """
    jobs, boards = dict[Path, tuple[str, Evaluation]](), dict[str, leaderboard.Board]()
    for study in studies:
        found = stored(study, boards)
        for variant in (one for one in study.variants if one.name not in found):
            name = f"{study.name}, {variant.name}"
            try:
                # a row without the study's shots and runs
                task = load_task(study.task) if study.is_row(variant) else study.task_of(variant)
                of = study.choice(variant, task)
                one = Evaluation(of.method, task, open_dataset(task), MADE / study.place(variant), of.parameters,
                                 preset=of.preset, training=study.training(variant))
            except VsfsimError as error:
                yield name, str(error)
                continue
            jobs.setdefault(one.path, (name, one))
    for made in make([one for _, one in jobs.values()], processes, check=False, progress=progress):
        yield jobs[made.path][0], str(made.failure or "")


def on_other_data(found: Mapping[str, Found]) -> list[str]:
    """Variants on the dataset of the first one, by its recipe, that were made on other bits of it.

    Args:
        found: results by variant.
    """
    names: dict[tuple[str, ...], list[str]] = {}
    for name, one in found.items():
        names.setdefault(tuple(dict.fromkeys(one.result.readings.get("object", ()))), []).append(name)
    return [name for same in names.values() for name in same[1:]
            if found[name].result.dataset_sha256 != found[same[0]].result.dataset_sha256]
