"""A result: one JSON file with the task, the method, the dataset, the scores, and the raw numbers of every score."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from vsfsim.bench.metrics import METRICS, Answer, Score, scores_of
from vsfsim.bench.result_file import SCHEMA_VERSION, Count, Size, as_rows, beside_zero, checked, pack, read_json
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.plain_text import plain
from vsfsim.core.system.interactive import html_table, new_figure
from vsfsim.data.disk import write_atomic, write_figure
from vsfsim.data.provenance import processor

FORMAT = "vsfsim-result"


@dataclass(frozen=True, repr=False)
class Result:
    """One method on one task."""

    task: str
    """Name of the task."""
    task_sha256: str
    """Of its file, see `task.Task.sha256`."""
    dataset_sha256: str
    """Of the dataset's content."""
    dataset_made_by: Mapping[str, Any]
    """Version and commit of vsfsim that made the dataset."""
    method: str
    """Name of the method."""
    entry: str
    """Its module:attribute."""
    parameters: Mapping[str, Any]
    """Of the constructor, all of them."""
    observation: str
    """Name of what a reading is."""
    unit: str
    """Of a reading."""
    shots: tuple[str, ...]
    """Labels."""
    seeds: tuple[Count, ...]
    """Of the support draws."""
    scores: Mapping[str, Mapping[str, Score]]
    """By metric and shot."""
    queries: Mapping[str, list]
    """Columns with one row a query touch, shot and seed: object, shot, seed, touch, number of readings n, sum of
    squared errors sse [unit^2]."""
    timing: Mapping[str, Size]
    """Seconds meta_fit_s, adapt_s and predict_s, and the numbers of calls fits, adapts and predicts."""
    peak_memory_mib: Size
    """Of the process [MiB]."""
    machine: Mapping[str, Any]
    """CPU, cores, system."""
    made_by: Mapping[str, Any]
    """Version and commit of vsfsim that scored it."""
    versions: Mapping[str, str]
    """Of the packages."""
    notes: tuple[str, ...] = ()
    """For the reader."""
    readings: Mapping[str, list] = dataclasses.field(default_factory=dict)
    """Summary of the true readings of the query touches, columns with one row a touch: object, touch, number of
    readings n, their sum of squares ss [unit^2]. They tell whether a dataset with other bits, made on another machine,
    is equivalent. Empty in results that are older than this field."""
    package: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """``name`` and ``version`` of the installed package that the method is from, "" for a file that is not
    installed."""
    isolation: str = ""
    """The sandbox in which the method ran, a name of `vsfsim.bench.isolation.limits.SANDBOXES`; "" where the scorer
    did not run it."""
    data: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fingerprints of the dataset (`vsfsim.bench.admission.fingerprint.Record.table`) where its bits are not those of
    the task's record; {} where they are, or the task has no record."""
    answers: Mapping[str, Mapping[str, list]] = dataclasses.field(default_factory=dict)
    """As `queries`, by the name of what else was answered (`vsfsim.bench.metrics.Answer`): columns with one row a
    query touch, or one an object with its metrics."""
    contents: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """sha256 of everything that decided the answers, by name (`vsfsim.bench.identity.contents_of`); {} in results that
    are older than this field, and where the scorer did not run the method."""
    preset: str = ""
    """Name of the settings that were asked for (`vsfsim.bench.commands.catalogue`), "" for none."""
    maps: Mapping[str, list] = dataclasses.field(default_factory=dict)
    """Of a task with cross-validation, the stiffness that the method gave in its first run at the shot that ranks,
    columns with one row a probed point: object, place x, y, z [0.1 mm from -3 m], truth [N/m], mean in the
    method's unit."""
    study: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """What the method learned from where that is not what the task says (`vsfsim.bench.trials.training.Training`),
    else {}. A result with it is a study's and is never ranked."""
    values: Mapping[str, Mapping[str, Mapping[str, Any]]] = dataclasses.field(default_factory=dict)
    """Of a row that ships (`vsfsim.bench.board.rows`), in place of `queries` and `answers`: the value of each object in
    each run, or their mean alone, by metric, shot and object. Else {}."""

    def has(self, parameters: Mapping[str, Any]) -> bool:
        """Whether the method had these parameters, on whatever device."""
        return all(self.parameters.get(key) == value for key, value in parameters.items() if key != "device")

    def summary(self) -> dict[str, Any]:
        """For JSON: everything but the raw numbers of every query."""
        raw = ("queries", "readings", "answers", "data", "maps", "values", "scores")
        told = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name not in raw}
        return {**told, "scores": {metric: {shot: dataclasses.asdict(score) for shot, score in by_shot.items()}
                                   for metric, by_shot in self.scores.items()}}

    def __repr__(self) -> str:
        metric = next(iter(self.scores), "")
        shots = ", ".join(f"{score.mean:.3f} at {shot}-shot" for shot, score in self.scores.get(metric, {}).items())
        return f"Result({self.method} on {self.task}, {len(self.seeds)} seeds: {metric} {shots})"

    def _repr_html_(self) -> str:
        return html_table(f"{self.task}, mean ± std over {len(self.seeds)} seeds", *self.table())

    def table(self, first: str = "") -> tuple[list[str], list[list[str]]]:
        """Head and rows of a table: every metric by shot, that called ``first`` before the others."""
        units = {name: unit_of(name, self.unit) for name in sorted(self.scores, key=lambda name: name != first)}
        return [self.method, *(f"{shot}-shot" for shot in self.shots)], [
            [f"{name} [{unit}]" if unit else name, *(score_text(self.scores[name].get(shot)) for shot in self.shots)]
            for name, unit in units.items()]

    def plot(self, metric: str = "rmse", path: str | Path | None = None) -> Any:
        """Draw a metric over the number of touches, with its standard deviation over seeds.

        Args:
            metric: a key of `scores`.
            path: PNG to write, or None.

        Returns:
            The `matplotlib.figure.Figure`, which a notebook shows.

        Raises:
            TaskError: the result has no such metric.
        """
        if metric not in self.scores:
            raise TaskError(f"the result of {self.method} has no metric '{metric}'. "
                            f"{did_you_mean(metric, self.scores)}")
        by_shot = self.scores[metric]
        figure = new_figure(figsize=(6.0, 3.6), dpi=110, layout="tight")
        axes = figure.subplots()
        axes.errorbar(list(by_shot), [s.mean for s in by_shot.values()], yerr=[s.std for s in by_shot.values()],
                      marker="o", capsize=3)
        axes.set(xlabel="touches of the test object", ylabel=f"{metric} (readings in {self.unit})", ylim=(0.0, None),
                 title=f"{self.method} on {self.task}")
        axes.grid(alpha=0.3)
        if path is not None:
            write_figure(figure, path)
        return figure

    def save(self, path: str | Path) -> None:
        """Write the JSON; the file appears whole or not at all.

        Raises:
            TaskError: it cannot be written.
        """
        path = Path(path)
        table = {"format": FORMAT, "schema_version": SCHEMA_VERSION, **self.summary(),
                 **{key: pack(getattr(self, key)) for key in ("queries", "readings", "maps", "values")},
                 "answers": {name: pack(columns) for name, columns in self.answers.items()}, "data": self.data}
        lines = [f"{json.dumps(key)}: {json.dumps(value, default=str, allow_nan=False)}"
                 for key, value in table.items()]
        write_atomic(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode(), error=TaskError)

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Read and check a result file.

        Raises:
            TaskError: the file is not a result, it has another schema version, or a field is missing or malformed.
        """
        path = Path(path)
        table = read_json(path)
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise TaskError(f"{path} is not a result of `vsfsim evaluate`.")
        if table.get("schema_version") != SCHEMA_VERSION:
            raise TaskError(f"result {path} has schema version {plain(table.get('schema_version'), longest=40)}; this "
                            f"vsfsim reads {SCHEMA_VERSION}. Evaluate the method again.")
        try:
            return checked(table, cls)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
            what = f"it has no {error}" if isinstance(error, KeyError) else plain(error, longest=300)
            raise TaskError(f"result {path} is malformed: {what}. Evaluate the method again.") from error

    @functools.cached_property
    def rows(self) -> list[dict[str, Any]]:
        """`queries` as rows, each beside what predicting zero errs (`vsfsim.bench.result_file.beside_zero`). They
        are made once, and are not the caller's to change."""
        return beside_zero(as_rows(self.queries), self.readings)

    def rows_of(self, answer: Answer) -> list[dict[str, Any]]:
        """What is kept of an answer, as rows; [] of none."""
        return self.rows if answer is Answer.READINGS else as_rows(self.answers.get(answer.value, {}))

    def computed(self) -> dict[str, dict[str, Score]]:
        """The scores, computed again from `queries` and `answers`; what `scores` says is not looked at."""
        return {metric: by_shot for answer in Answer
                for metric, by_shot in scores_of(answer, self.rows_of(answer), self.shots, self.seeds).items()}


def unit_of(metric: str, of_reading: str) -> str:
    """Of a metric, "" for a pure number and for one that this version does not know."""
    unit = METRICS[metric].unit if metric in METRICS else ""
    return of_reading if unit is None else unit


def score_text(score: Score | None) -> str:
    """A score with its deviation over runs, "" for none."""
    return "" if score is None else f"{score.mean:.3f} ± {score.std:.3f}"


def machine() -> dict[str, Any]:
    """The machine: cpu, cores, system."""
    return {"cpu": processor().partition(", family")[0], "cores": os.cpu_count(),
            "system": f"{platform.system()} {platform.machine()}"}


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that can change a number."""
    out = {"python": platform.python_version()}
    for package in ("numpy", "scipy", "h5py", "warp-lang", "torch"):
        with contextlib.suppress(PackageNotFoundError):
            out[package] = version(package)
    return out
