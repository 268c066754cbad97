"""A study: variants of an evaluation that are compared object by object, read from a file of tasks/studies/.

A file says which tasks are asked, and for each variant the method, its settings and what it learns from. The claims of
a paper that its results decide stand in the same file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from papers.figures import figure
from vsfsim.bench.commands.catalogue import Choice
from vsfsim.bench.commands.catalogue import preset as chosen
from vsfsim.bench.metrics import METRICS
from vsfsim.bench.task import DatasetWanted, Task, load_task, one_of, open_dataset, typed
from vsfsim.bench.trials.training import RULES, Extra, Training
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.shelf import folder
from vsfsim.core.table import Count, Positive, Share, T, parse_toml, read_text


@dataclass(frozen=True)
class Pool:
    """Training objects of another dataset, ``extra`` of a variant."""

    data: str
    """Name of a table [data.NAME]."""
    objects: Positive
    """How many of them, the first ones."""


@dataclass(frozen=True)
class Variant:
    """``[[variant]]``: one row of a study."""

    name: str
    """In the study."""
    method: str
    """Name of the method."""
    preset: str = "tuned"
    """Of its settings."""
    set: Mapping[str, Any] = field(default_factory=dict)
    """Parameters over those of the preset."""
    train: str = "others"
    """A key of `vsfsim.bench.trials.training.RULES`."""
    share_of_objects: Share = 1.0
    """Share of the training objects."""
    share_of_touches: Share = 1.0
    """Share of the touches of each."""
    train_views: tuple[Count, ...] = ()
    """Of training objects; () for all."""
    test_views: tuple[Count, ...] = ()
    """That are scored; () for all."""
    extra: tuple[Pool, ...] = ()
    """Further training objects."""
    data: str = ""
    """Name of a table [data.NAME] whose dataset takes the place of the task's; "" for the task's."""
    paper: Mapping[str, float | tuple[float, float]] = field(default_factory=dict)
    """The paper's figures: mean, or mean and spread, by shot."""


@dataclass(frozen=True)
class Asked:
    """``[[claim]]``, which two variants decide."""

    text: str
    """In our words."""
    better: tuple[str, str]
    """Variant and shot that are claimed to be better."""
    worse: tuple[str, str]
    """Than which."""
    metric: str
    """By which metric; default: the study's."""
    source: str = ""
    """Paper and place."""
    figures: tuple[str, ...] = ()
    """Cells of `papers.figures` of both sides; () where the paper prints none."""
    words: str = "drawn, no number"
    """In the place of figures."""
    equal: bool = False
    """The claim is that they cannot be told apart."""
    note: str = ""
    """What is different here."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """One study: the keys of its file."""

    title: str
    """One line."""
    source: str
    """Paper and table."""
    unit: str = ""
    """Of the paper's figures."""
    metric: str = "rmse_ratio"
    """Name of the metric that is shown."""
    task: str
    """Name of the task that is asked."""
    baseline: str
    """Variant from which the differences are."""
    shots: tuple[Count, ...] = ()
    """Instead of the task's; () for the task's."""
    trainings: Count = 0
    """Instead of the task's; 0 for the task's."""
    draws: Count = 0
    """Instead of the task's; 0 for the task's."""
    data: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Datasets other than the task's, by name: fields of `DatasetWanted` over those of the task, or of another one that
    is named by ``task``."""
    note: str = ""
    """What is different here."""
    name: str = ""
    """Of its file."""
    variants: tuple[Variant, ...] = ()
    """In order."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of all variants."""
    claims: tuple[Asked, ...] = ()
    """Of the paper."""

    def task_of(self, variant: Variant) -> Task:
        """The task that a variant asks, with the study's shots and runs."""
        task = load_task(self.task)
        return self._asked(task if not variant.data else dataclasses.replace(task, dataset=self.wanted(variant.data)))

    def _asked(self, task: Task) -> Task:
        p = task.protocol
        return dataclasses.replace(task, protocol=dataclasses.replace(
            p, shots=self.shots or p.shots, trainings=self.trainings or p.trainings, draws=self.draws or p.draws))

    def wanted(self, name: str) -> DatasetWanted:
        """The dataset that a table [data.NAME] describes."""
        given = dict(self.data[name])
        base = load_task(given.pop("task", self.task)).dataset
        same = given.get("scene", base.scene) == base.scene  # the scene that the task was made with
        return dataclasses.replace(base, **{"sha256": "", "scene_sha256": base.scene_sha256 if same else "", **given})

    def is_row(self, variant: Variant) -> bool:
        """Whether a variant is what `vsfsim evaluate --preset` makes of the task, so that a row of its leaderboard
        serves."""
        return variant == Variant(variant.name, variant.method, variant.preset, paper=variant.paper)

    def choice(self, variant: Variant, task: Task) -> Choice:
        """The method with all its settings.

        Raises:
            MethodError: it has no such preset.
        """
        # a row of a leaderboard is asked for what its task's metric scores, a variant of its own for the study's
        metric = task.metric if self.is_row(variant) else METRICS[self.metric]
        known = chosen(variant.method, variant.preset, task.observation.name, metric.answer.value)
        return dataclasses.replace(known, parameters={**known.parameters, **variant.set})

    def stem(self, variant: Variant) -> str:
        """Of the result file: the same for the same evaluation in another study."""
        data = [self.data.get(name) for name in (variant.data, *(p.data for p in variant.extra))]
        told = dataclasses.replace(variant, name="", paper={}), data, self.shots, self.trainings, self.draws
        words = [f"{variant.method}.{variant.preset}", *variant.set.values(), variant.train, variant.data,
                 *(f"{p.data}{p.objects}" for p in variant.extra), hashlib.sha256(repr(told).encode()).hexdigest()[:8]]
        return re.sub(r"[^A-Za-z0-9.+-]+", "_", "-".join(str(word) for word in words if word != ""))

    def place(self, variant: Variant) -> Path:
        """Of the result file of a variant, in the folder of results or of rows that ship."""
        return Path(self.task, f"{variant.method}.{variant.preset}.json") if self.is_row(variant) else (
            Path("studies", self.task_of(variant).name, f"{self.stem(variant)}.json"))

    def command(self, variant: Variant) -> str:
        """Which makes that file in results/."""
        return f"vsfsim evaluate --method {variant.method} --preset {variant.preset} --task {self.task}" if (
            self.is_row(variant)) else f"vsfsim papers study {self.name}"

    def training(self, variant: Variant) -> Training:
        """What a variant learns from.

        Raises:
            TaskError: a dataset of further objects is missing, with the command that makes it.
        """
        extra = []
        for pool in variant.extra:
            of = self._asked(load_task(self.data[pool.data].get("task", self.task)))
            of = dataclasses.replace(of, dataset=self.wanted(pool.data))
            extra.append(Extra(of, open_dataset(of), pool.objects))
        return Training(variant.train, variant.share_of_objects, variant.share_of_touches, variant.train_views,
                        variant.test_views, tuple(extra))


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
        raise TaskError(f"unknown study '{name}'. {did_you_mean(name, found)} `vsfsim papers study` lists them.")
    path = found.get(name, Path(name))
    return parse_study(read_text(path, "study", TaskError), path)


def parse_study(text: str, path: Path) -> Study:
    """Like `load_study`, from text; ``path`` names it in messages."""
    given, where = parse_toml(text, path, "study", TaskError), str(path)
    rows = {key: given.pop(key, []) for key in ("variant", "claim")}
    head = typed(given, Study, where)
    one_of(head.metric, METRICS, f"{path}: metric")
    variants = _records(rows["variant"], Variant, head.settings, f"{path} [[variant]]")
    claims = _records(rows["claim"], Asked, {"metric": head.metric}, f"{path} [[claim]]")
    study = dataclasses.replace(head, name=path.stem, variants=variants, claims=claims)
    if len({v.name for v in variants}) < max(len(variants), 2):
        raise TaskError(f"{path}: a study compares two or more [[variant]] with different names; it has "
                        f"{', '.join(v.name for v in variants) or 'none'}.")
    for name in (name for asked in claims for name in asked.figures):
        figure(name)
    for name in (study.baseline, *(side[0] for asked in claims for side in (asked.better, asked.worse))):
        one_of(name, {v.name for v in variants}, f"{path}: a variant")
    for v in variants:
        where = f"{path}: variant '{v.name}'"
        one_of(v.train, RULES, f"{where}: train")
        for name in (v.data, *(p.data for p in v.extra)):
            one_of(name, ("", *study.data), f"{where}: data")
    return study


def _records(rows: Any, kind: type[T], over: Mapping[str, Any], where: str) -> tuple[T, ...]:
    """Tables of a list as records, each over some settings."""
    if not isinstance(rows, list):
        raise TaskError(f"{where} is {rows!r}; it must be a list of tables.")
    return tuple(typed({**over, **row} if isinstance(row, dict) else row, kind, f"{where} {k}")
                 for k, row in enumerate(rows, start=1))
