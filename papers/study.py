"""A study: variants of an evaluation that are compared object by object, read from a file of tasks/studies/.

A file says which tasks are asked, and for each variant the method, its settings and what it learns from. The claims of
a paper that its results decide stand in the same file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from papers import worlds
from papers.figures import figure
from vsfsim.bench.commands.presets import Choice
from vsfsim.bench.commands.presets import preset as chosen
from vsfsim.bench.metrics import METRICS
from vsfsim.bench.task import DatasetWanted, Task, load_task, open_dataset
from vsfsim.bench.trials.training import RULES, Extra, Training
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.shelf import folder
from vsfsim.core.table import Table, parse_toml, read_text
from vsfsim.data.dataset import Dataset

SIZES = ("mini", "standard")
_SETTINGS = ("method", "preset", "set", "train", "share_of_objects", "share_of_touches", "train_views", "test_views",
             "extra", "data", "world", "only")


@dataclass(frozen=True)
class Pool:
    """Training objects of another dataset, ``extra`` of a variant."""

    data: str
    """Name of a table [data.NAME]."""
    objects: int
    """How many of them."""
    first: int
    """Number of the first of them."""


@dataclass(frozen=True)
class Variant:
    """One row of a study."""

    name: str
    """In the study."""
    method: str
    """Name of the method."""
    preset: str
    """Of its settings."""
    parameters: Mapping[str, Any]
    """Over those of the preset."""
    train: str
    """A key of `vsfsim.bench.trials.training.RULES`."""
    objects: float
    """Share of the training objects."""
    touches: float
    """Share of the touches of each."""
    train_views: tuple[int, ...]
    """Of training objects; () for all."""
    test_views: tuple[int, ...]
    """That are scored; () for all."""
    extra: tuple[Pool, ...]
    """Further training objects."""
    data: str
    """Name of a table [data.NAME] whose dataset takes the place of the task's; "" for the task's."""
    world: str
    """A key of `papers.worlds.WORLDS` that takes the place of the task; "" for none."""
    only: str
    """Class of the objects that count; "" for all."""
    paper: Mapping[str, tuple[float, float | None]]
    """The paper's figures: mean and spread by shot."""


@dataclass(frozen=True)
class Asked:
    """A claim, or an experiment on one, that two variants decide."""

    text: str
    """In our words; of an experiment the key of the claim."""
    source: str
    """Paper and place."""
    figures: tuple[str, ...]
    """Cells of `papers.figures` of both sides; () where the paper prints none."""
    words: str
    """In the place of figures."""
    better: tuple[str, str]
    """Variant and shot that are claimed to be better."""
    worse: tuple[str, str]
    """Than which."""
    equal: bool
    """The claim is that they cannot be told apart."""
    metric: str
    """By which metric."""
    note: str
    """What is different here, or of an experiment what it changes."""


@dataclass(frozen=True)
class Study:
    """One study."""

    name: str
    """Of its file."""
    title: str
    """One line."""
    source: str
    """Paper and table."""
    unit: str
    """Of the paper's figures."""
    metric: str
    """Name of the metric that is shown."""
    tasks: Mapping[str, str]
    """Name of the task by size; {} where every variant has a world."""
    baseline: str
    """Variant from which the differences are."""
    shots: tuple[int, ...]
    """Instead of the task's; () for the task's."""
    trainings: int
    """Instead of the task's; 0 for the task's."""
    draws: int
    """Instead of the task's; 0 for the task's."""
    folds: int
    """Instead of the task's; 0 for the task's."""
    variants: tuple[Variant, ...]
    """In order."""
    classes: Mapping[str, str]
    """Class of each model."""
    data: Mapping[str, Mapping[str, Any]]
    """Datasets other than the tasks', by name: fields of `DatasetWanted` over those of the task, in a table a size."""
    claims: tuple[Asked, ...]
    """Of the paper."""
    experiments: tuple[Asked, ...]
    """On claims that do not hold: each asks the same of other data."""
    note: str
    """What is different here."""

    def variant(self, name: str) -> Variant:
        """Raises:
            TaskError: there is none of this name.
        """
        found = {v.name: v for v in self.variants}
        if name not in found:
            raise TaskError(f"study {self.name} has no variant '{name}'. {did_you_mean(name, found)}")
        return found[name]

    def has(self, variant: Variant, size: str) -> bool:
        """Whether it has a task of this size for a variant."""
        return bool(variant.world) or (size in self.tasks and all(
            size in self.data[name] for name in (variant.data, *(p.data for p in variant.extra)) if name))

    def task_of(self, variant: Variant, size: str) -> Task:
        """The task that a variant asks, with the study's shots and runs.

        Raises:
            TaskError: the study has no task of this size.
        """
        if variant.world:
            task = worlds.task(variant.world)
        else:
            if size not in self.tasks:
                raise TaskError(f"study {self.name} has no task of the size '{size}'; it has "
                                f"{' and '.join(self.tasks)}.")
            task = load_task(self.tasks[size])
        if variant.data:
            task = dataclasses.replace(task, dataset=self.wanted(variant.data, size, task))
        return self._asked(task)

    def _asked(self, task: Task) -> Task:
        p = task.protocol
        trainings, draws = self.trainings or p.trainings, self.draws or p.draws
        if (self.folds or self.trainings or self.draws) and not trainings * draws:
            raise TaskError(f"study {self.name} asks the task {task.name} for {trainings} trainings and {draws} draws "
                            f"of the support. That task has no cross-validation of its own; give trainings = ... and "
                            f"draws = ... of 1 or more in the study's file.")
        protocol = dataclasses.replace(p, shots=self.shots or p.shots, trainings=trainings, draws=draws,
                                       folds=self.folds or p.folds, seeds=trainings * draws)
        return dataclasses.replace(task, protocol=protocol)

    def wanted(self, name: str, size: str, task: Task) -> DatasetWanted:
        """The dataset that a table [data.NAME] describes.

        Raises:
            TaskError: there is no such table for this size.
        """
        if name not in self.data or size not in self.data[name]:
            raise TaskError(f"study {self.name} has no [data.{name}.{size}].")
        given = dict(self.data[name][size])
        base = load_task(given.pop("task")).dataset if "task" in given else task.dataset
        same = given.get("scene", base.scene) == base.scene  # the scene that the task was made with
        return dataclasses.replace(base, **{"sha256": "", "scene_sha256": base.scene_sha256 if same else "", **given})

    def is_row(self, variant: Variant) -> bool:
        """Whether a variant is what `vsfsim evaluate --preset` makes of the task, so that a row of its leaderboard
        serves."""
        return (variant.train, variant.objects, variant.touches) == ("others", 1.0, 1.0) and not (
            variant.parameters or variant.train_views or variant.test_views or variant.extra or variant.data
            or variant.world)

    def choice(self, variant: Variant, task: Task) -> Choice:
        """The method with all its settings.

        Raises:
            MethodError: it has no such preset.
        """
        # a row of a leaderboard is asked for what its task's metric scores, a variant of its own for the study's
        metric = task.metric if self.is_row(variant) else METRICS[self.metric]
        known = chosen(variant.method, variant.preset, task.observation.name, metric.answer.value)
        return dataclasses.replace(known, parameters={**known.parameters, **variant.parameters})

    def stem(self, variant: Variant) -> str:
        """Of the result file: the same for the same evaluation in another study."""
        told = {"set": dict(variant.parameters), "train": variant.train, "objects": variant.objects,
                "touches": variant.touches, "views": [variant.train_views, variant.test_views],
                "extra": [[p.data, p.objects, p.first, self.data.get(p.data)] for p in variant.extra],
                "data": self.data.get(variant.data), "world": variant.world,
                "protocol": [self.shots, self.trainings, self.draws, *([self.folds] if self.folds else [])]}
        words = [f"{variant.method}.{variant.preset}", *(str(v) for v in variant.parameters.values()),
                 *([variant.train] if variant.train != "others" else []), *([variant.data] if variant.data else []),
                 *(f"{p.data}{p.objects}" for p in variant.extra)]
        digest = hashlib.sha256(json.dumps(told, sort_keys=True, default=str).encode()).hexdigest()[:8]
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", "-".join([*words, digest]))

    def dataset_of(self, variant: Variant, task: Task) -> Dataset:
        """The variant's dataset; that of a world is made if it is missing.

        Raises:
            TaskError: it is missing, with the command that makes it.
            DatasetError: it is damaged.
        """
        return worlds.dataset(variant.world) if variant.world else open_dataset(task)

    def training(self, variant: Variant, task: Task, size: str) -> Training:
        """What a variant learns from.

        Raises:
            TaskError: a dataset of further objects is missing, with the command that makes it.
        """
        extra = []
        for pool in variant.extra:
            given = self.data.get(pool.data, {}).get(size, {})
            of = self._asked(load_task(given["task"])) if "task" in given else task
            of = dataclasses.replace(of, dataset=self.wanted(pool.data, size, task))
            extra.append(Extra(of, open_dataset(of), pool.objects, pool.first))
        return Training(variant.train, variant.objects, variant.touches, variant.train_views, variant.test_views,
                        self.classes, tuple(extra))


def studies() -> dict[str, Path]:
    """The files of the studies that ship, by name."""
    return {path.stem: path for path in sorted((folder("tasks") / "studies").glob("*.toml"))}


def load_study(name: str) -> Study:
    """The study of this name, or in this .toml file.

    Raises:
        TaskError: there is none, it is not TOML, a key is unknown or missing, or a value is out of range.
    """
    found = studies()
    if name not in found and not name.endswith(".toml"):
        raise TaskError(f"unknown study '{name}'. {did_you_mean(name, found)} `vsfsim study` lists them.")
    path = found.get(name, Path(name))
    return parse_study(read_text(path, "study", TaskError), path)


def parse_study(text: str, path: Path) -> Study:
    """Like `load_study`, from text; ``path`` names it in messages."""
    top = Table(parse_toml(text, path, "study", TaskError), str(path), (
        "title", "source", "unit", "metric", "tasks", "baseline", "shots", "trainings", "draws", "folds", "settings",
        "variant", "classes", "data", "claim", "experiment", "note"), error=TaskError)
    metric = top.text("metric", "rmse_ratio")
    if metric not in METRICS:
        raise TaskError(f"{path}: metric is '{metric}'. {did_you_mean(metric, METRICS)}")
    settings = _plain(top, "settings")
    variants = tuple(_variant(row, settings, f"{path} [[variant]] {k + 1}")
                     for k, row in enumerate(top.rows("variant")))
    classes = {str(model): str(kind) for kind, models in _plain(top, "classes").items() for model in models}
    shots = top.counts("shots")
    out = Study(
        path.stem, top.text("title"), top.text("source"), top.text("unit", ""), metric,
        {str(k): str(v) for k, v in _plain(top, "tasks").items()}, top.text("baseline", ""), shots,
        top.count("trainings", 0, 0), top.count("draws", 0, 0), top.count("folds", 0, 0), variants, classes,
        _plain(top, "data"),
        tuple(_asked(row, metric, f"{path} [[claim]] {k + 1}") for k, row in enumerate(top.rows("claim"))),
        tuple(_asked(row, metric, f"{path} [[experiment]] {k + 1}") for k, row in enumerate(top.rows("experiment"))),
        top.text("note", ""))
    _check(out, path)
    return out


def _check(study: Study, path: Path) -> None:
    names = [v.name for v in study.variants]
    if len(set(names)) < len(names) or len(names) < 2:
        raise TaskError(f"{path}: a study compares two or more [[variant]] with different names; it has "
                        f"{', '.join(names) or 'none'}.")
    for name in (study.baseline, *(side[0] for a in (*study.claims, *study.experiments)
                                   for side in (a.better, a.worse))):
        study.variant(name)
    for v in study.variants:
        for name in (v.data, *(p.data for p in v.extra)):
            if name and name not in study.data:
                raise TaskError(f"{path}: variant '{v.name}' names the data '{name}'. {did_you_mean(name, study.data)}")
    for size in study.tasks:
        if size not in SIZES:
            raise TaskError(f"{path}: tasks names the size '{size}'. {did_you_mean(size, SIZES)}")


def _plain(top: Table, key: str) -> dict[str, Any]:
    value = top.table.get(key, {})
    if not isinstance(value, dict):
        raise TaskError(f"{top.where}: {key} is {value!r}; it must be a table.")
    return value


def _variant(row: Mapping[str, Any], settings: Mapping[str, Any], where: str) -> Variant:
    t = Table({**settings, **row}, where, ("name", "paper", *_SETTINGS), error=TaskError)
    train = t.text("train", "others")
    if train not in RULES:
        raise TaskError(f"{where}: train is '{train}'. {did_you_mean(train, RULES)}")
    world = t.text("world", "")
    if world and world not in worlds.WORLDS:
        raise TaskError(f"{where}: world is '{world}'. {did_you_mean(world, worlds.WORLDS)}")
    paper = {str(shot): _figure(v, f"{where} paper: {shot}") for shot, v in _plain(t, "paper").items()}
    extra = tuple(_pool(p, f"{where} extra {k + 1}") for k, p in enumerate(t.rows("extra")))
    return Variant(t.text("name"), t.text("method"), t.text("preset", "tuned"), _plain(t, "set"), train,
                   t.number("share_of_objects", 1.0, 0.0, 1.0), t.number("share_of_touches", 1.0, 0.0, 1.0),
                   t.counts("train_views"), t.counts("test_views"), extra,
                   t.text("data", ""), world, t.text("only", ""), paper)


def _pool(row: Any, where: str) -> Pool:
    t = Table(row, where, ("data", "objects", "first"), error=TaskError)
    return Pool(t.text("data"), t.count("objects", None, 1), t.count("first", 0, 0))


def _figure(value: Any, where: str) -> tuple[float, float | None]:
    """A figure of the paper: a number, or its mean and spread."""
    given = value if isinstance(value, list) else [value]
    if len(given) not in (1, 2) or any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in given):
        raise TaskError(f"{where} is {value!r}; give a number, or [mean, spread].")
    return float(given[0]), float(given[1]) if len(given) == 2 else None


def _asked(row: Mapping[str, Any], metric: str, where: str) -> Asked:
    t = Table(dict(row), where, ("text", "source", "figures", "better", "worse", "equal", "metric", "note"),
              error=TaskError)
    sides = []
    for key in ("better", "worse"):
        side = t.need(key)
        if not isinstance(side, list) or len(side) != 2:
            raise TaskError(f"{where}: {key} is {side!r}; give a variant and a shot, e.g. [\"narrow\", \"0\"].")
        sides.append((str(side[0]), str(side[1])))
    cells = t.table.get("figures", "drawn, no number")
    for name in cells if isinstance(cells, list) else ():
        figure(name)
    figures, words = (tuple(cells), "") if isinstance(cells, list) else ((), str(cells))
    return Asked(t.text("text"), t.text("source", ""), figures, words, sides[0], sides[1],
                 t.flag("equal", False), t.text("metric", metric), t.text("note", ""))
