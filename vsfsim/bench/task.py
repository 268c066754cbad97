"""A task: data, protocol, observation and metric, as a versioned TOML file that never changes once released."""

from __future__ import annotations

import re
import shlex
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from vsfsim.bench.metrics import METRICS, Metric
from vsfsim.bench.noise import NOISE_KINDS, Noise
from vsfsim.bench.observations import Observation, observation
from vsfsim.core import errors, table
from vsfsim.core.errors import DatasetError, TaskError, did_you_mean
from vsfsim.core.shelf import datasets, find_task, folder
from vsfsim.core.table import Count, Positive, parse_toml, read_text
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import text_sha256

typed, one_of = partial(table.typed, error=TaskError), partial(errors.one_of, error=TaskError)
"""Of a task or a study: what is wrong with its file is a `TaskError`."""

ALL = "all"
"""The shot that means every touch which is not a query."""

DEVELOPMENT = "development"
"""The name of a task on its development objects ends in it."""

SEALED = "sealed"
"""The same of a task on objects of a seed that only their keeper knows (`vsfsim.bench.predictions.seal`)."""

OTHERS = re.compile(r"(.+)-(development|seed-\d+|sealed)")
"""Name of a task on other objects than its own (`Task.on`)."""

_NOT_COUNTED = re.compile(r'(?m)^unresolved *= *"scored".*\n')
"""A line that the sha256 of a task is not of: tasks were released before they said that unresolved frames count."""

_SAID = {"scene_sha256": "sha256 of the scene text", "sha256": "sha256 of the content"}


@dataclass(frozen=True)
class DatasetWanted:
    """``[dataset]``: which dataset the task needs, and how to make it."""

    folder: str
    """Its place under ``datasets/``."""
    scene: str
    """Name of the scene."""
    seed: Count
    """Of the recipe."""
    objects: Positive
    """Of the recipe."""
    views: Positive
    """Of each object."""
    touches: Positive
    """Of each view."""
    scene_sha256: str = ""
    """Of the scene's text, or "" for any."""
    tier: str = "auto"
    """Of the recipe, or "auto" for any."""
    sha256: str = ""
    """Of the content, or "" for any."""
    recorded: str = ""
    """Commands that make it of recordings, which are not made by a scene; "" for data of a scene."""

    def path(self) -> Path:
        """Where it is looked for: under $VSFSIM_DATASETS, else under ./datasets."""
        return datasets() / self.folder

    def command(self, out: Path | None = None) -> str:
        """The command that makes it, quoted for a shell."""
        if self.recorded:
            return f"{self.recorded} --out {shlex.quote(str(out or self.path()))}"
        counts = f"--objects {self.objects} --views {self.views} --touches {self.touches} --seed {self.seed}"
        return shlex.join(["vsfsim", "generate", self.scene, *counts.split(), "--tier", self.tier,
                           "--out", str(out or self.path())])


@dataclass(frozen=True)
class Protocol:
    """``[protocol]``: the few-shot protocol, with two fixed splits, or with cross-validation over objects (``folds``).

    With cross-validation a run is one training and one draw of the support sets: run = training x draws + draw. A
    method without a ``seed`` has one training.
    """

    shots: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
    """Sizes of the support set, increasing."""
    query: Positive
    """Number of query touches of each test object, the same for every shot and seed."""
    seed: Count
    """Root of all draws."""
    train: str = "train"
    """Name of the split that methods learn from; not used with cross-validation."""
    test: str = "test"
    """Name of the split that is scored; not used with cross-validation."""
    seeds: Count = 0
    """Number of draws of the support set; 0 with cross-validation."""
    folds: Count = 0
    """Parts into which the objects are divided, each of them tested once; 0 for the two splits above."""
    draws: Count = 0
    """With cross-validation, draws of the support set; else 0."""
    trainings: Count = 0
    """With cross-validation, trainings of a method with a ``seed``, each with another seed; else 0."""
    support: Literal["drawn", "chosen"] = "drawn"
    """"chosen": a method with `choose` names its support touches itself, one after the other; others are given the
    drawn ones."""
    unresolved: Literal["left out", "scored"] = "left out"
    """Whether frames are scored whose contact the mesh does not resolve (`vsfsim.data.records.Touch.resolved`)."""
    transfer: bool = False
    """Queries are the presses of other kinds than the scene's own (``[[touches.other]]``), and only its own are learned
    from, on training objects as well."""
    stations: Positive = 1
    """Of the scene (`vsfsim.core.scene_tables.dataset.TouchSpec.stations`): queries are the last touches of branches,
    supports the others; 1: any touch may be either."""

    def __post_init__(self) -> None:
        if sorted(set(self.shots)) != list(self.shots):
            raise ValueError(f"shots is {list(self.shots)}; give increasing whole numbers, e.g. [0, 1, 5, 10]")
        if self.folds and (self.folds < 2 or not (self.draws and self.trainings) or self.seeds):
            raise ValueError("with cross-validation every object is a test object once; give folds of at least 2, "
                             "draws and trainings of at least 1, and no seeds")
        if not self.folds and (self.draws or self.trainings or not self.seeds):
            raise ValueError("draws and trainings belong to cross-validation; give folds too, or give seeds of at "
                             "least 1 without them")

    def runs(self, *, seeded: bool) -> tuple[int, ...]:
        """Numbers of the runs of a method that takes a ``seed``, or does not."""
        return tuple(range(self.draws * (self.trainings if seeded else 1) if self.folds else self.seeds))

    def draw_of(self, run: int) -> int:
        """Number of the support draw of a run."""
        return run % self.draws if self.folds else run

    def training_of(self, run: int) -> int:
        """Number of the training of a run: the ``seed`` that the method is built with."""
        return run // self.draws if self.folds else run

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the shots in results: "0", "1", ..., "all"."""
        return (*(str(k) for k in self.shots), ALL)


@dataclass(frozen=True)
class Task:
    """One task."""

    name: str
    """With its version."""
    description: str
    """One sentence."""
    dataset: DatasetWanted
    """``[dataset]``."""
    development: DatasetWanted | None
    """``[dataset] development``: other objects of the same scene, on which settings are made; None without any."""
    protocol: Protocol
    """``[protocol]``."""
    observation: Observation
    """Row of the table of observations: what a reading is."""
    noise: Noise
    """``[noise]``: parameters of the sensors' noise."""
    primary: str
    """Name of the metric that ranks."""
    ranking_shot: str
    """The shot that ranks, e.g. "5"."""
    sha256: str
    """Of the task file's text."""

    @property
    def metric(self) -> Metric:
        """The row of `primary` in the table of metrics."""
        return METRICS[self.primary]

    def on(self, objects: str) -> Task:
        """The same questions on other objects, as a task of its own: its results are no rows of this one.

        Args:
            objects: "development"; "seed-N", as many objects of the recipe's seed N; or "sealed", any number of objects
            of any seed, which its text does not tell.

        Raises:
            TaskError: it is none of these; the seed is one of the task's own, or the task names no development objects.
        """
        text: dict[str, Any] = {"name": f"{self.name}-{objects}", "sha256": text_sha256(f"{self.sha256}-{objects}")}
        if objects == SEALED:
            return replace(self, dataset=replace(self.dataset, folder=f"{self.dataset.folder}-{SEALED}", sha256=""),
                           description=f"{self.description} On sealed objects.", development=None, **text)
        seed = re.fullmatch(r"seed-(\d{1,18})", objects)
        if objects != DEVELOPMENT and seed is None:
            raise TaskError(f"on is '{objects}'. {did_you_mean(objects, (DEVELOPMENT,))} Or give seed-N, for "
                            f"other objects of seed N.")
        wanted = self.development
        if seed is not None:
            own = {self.dataset.seed, *([wanted.seed] if wanted is not None else [])}
            if int(seed[1]) in own:
                raise TaskError(f"on is '{objects}', but task {self.name} has objects of seed {seed[1]} itself. Give "
                                f"another seed.")
            wanted = replace(self.dataset, folder=f"{self.dataset.folder}-{objects}", seed=int(seed[1]), sha256="")
        if wanted is None:
            raise TaskError(f"task {self.name} names no development objects ([dataset] development in its file). Give "
                            f"seed-N, for other objects of seed N.")
        return replace(self, dataset=wanted, development=None,
                       description=f"{self.description} On {objects} objects; never ranked.", **text)


def retired() -> dict[str, Any]:
    """Tasks that left the tree, of `leaderboard/retired.toml`: which one replaces each (``by``), and the ``commit``
    that holds it."""
    path = folder("leaderboard") / "retired.toml"
    return parse_toml(read_text(path, "retired tasks", TaskError), path, "retired tasks", TaskError)


def load_task(given: str | Path) -> Task:
    """The task of this name, or in this TOML file. TASK-development, TASK-seed-N and TASK-sealed are TASK on other
    objects (`Task.on`).

    Raises:
        TaskError: there is no such task, it is not TOML, a key is unknown or missing, or a value is out of range; of a
            retired task the message says what replaces it.
    """
    others = OTHERS.fullmatch(str(given))
    if others is not None:
        return load_task(others[1]).on(others[2])
    if given in retired():
        raise TaskError("task {} is retired: {by} replaces it, and commit {commit} of the repository holds it with its "
                        "rows.".format(given, **retired()[str(given)]))
    path = find_task(str(given))
    return parse_task(read_text(path, "task", TaskError), path)


def parse_task(text: str, path: str | Path) -> Task:
    """Like `load_task`, from text; ``path`` names it in messages."""
    tree = parse_toml(text, Path(path), "task", TaskError)
    # [[paper]], which released tasks have, is for who reads the file: studies hold the papers' figures
    at = {key: f"{path} [{key}]" for key in ("dataset", "protocol", "observation", "noise", "metrics", "paper")}
    wanted = typed(tree.get("dataset"), DatasetWanted, at["dataset"], also=("development",))
    development = None
    if "development" in tree["dataset"]:
        where = f"{at['dataset']} development"
        same = {key: getattr(wanted, key) for key in ("scene", "views", "touches", "scene_sha256", "tier")}
        development = typed(tree["dataset"]["development"], DatasetWanted, where, sha256="", **same)
        if development.seed == wanted.seed or development.folder == wanted.folder:
            raise TaskError(f"{where}: seed {development.seed} and folder '{development.folder}' must both differ from "
                            f"those of [dataset], so that no object is in both.")
    protocol = typed(tree.get("protocol"), Protocol, at["protocol"])
    noisy = table.check_keys(tree.get("noise"), at["noise"], ("kind", *(f.name for f in fields(Noise))), TaskError)
    kind = str(noisy.get("kind", ""))
    preset = NOISE_KINDS[one_of(kind, NOISE_KINDS, f"{at['noise']}: kind")] if kind else {}
    noise = typed({"offset_std": 0.0, "drift_std": 0.0, **preset, **noisy}, Noise, at["noise"], also=("kind",))
    metrics = table.check_keys(tree.get("metrics"), at["metrics"], ("primary", "ranking_shot"), TaskError)
    primary = one_of(metrics.get("primary", ""), [name for name, metric in METRICS.items() if metric.ranks],
                     f"{at['metrics']}: primary")
    ranking = str(metrics.get("ranking_shot"))
    if ranking not in protocol.labels:
        raise TaskError(f"{at['metrics']}: ranking_shot is {ranking}; it must be one of the shots: "
                        f"{', '.join(protocol.labels)}.")
    reads = table.check_keys(tree.get("observation"), at["observation"], ("kind",), TaskError)
    found = typed(tree, Task, str(path), also=tuple(at), dataset=wanted, development=development, protocol=protocol,
                  observation=observation(str(reads.get("kind", "")), at["observation"]), noise=noise, primary=primary,
                  ranking_shot=ranking, sha256=text_sha256(_NOT_COUNTED.sub("", text) + (
                      "" if protocol.unresolved == "scored" else "unresolved left out")))
    if not re.fullmatch(r"[a-z0-9-]+-v\d+", found.name):
        raise TaskError(f"{path}: name is {found.name!r}; a task's name ends in its version, e.g. "
                        f"fewshot-shoes-v3-mini-v1.")
    return found


def open_dataset(task: Task, path: str | Path | None = None) -> Dataset:
    """The task's dataset, checked against what the task wants.

    Args:
        task: the task. path: folder, or None for `DatasetWanted.path`.

    Raises:
        TaskError: the dataset is missing (with the command that makes it), or is another one.
        DatasetError: it is damaged.
    """
    place = task.dataset.path() if path is None else Path(path)
    try:
        dataset = Dataset.open(place)
    except DatasetError as error:
        if (place / "dataset.json").exists():
            raise
        raise TaskError(f"task {task.name}: {error} This makes it:\n\n  {task.dataset.command(place)}\n") from error
    free = ("folder", "recorded", *(("seed", "objects") if task.name.endswith(f"-{SEALED}") else ()))
    asked = {key: value for key, value in asdict(task.dataset).items() if key not in free and value not in ("", "auto")}
    # a recipe names the tier that was chosen, never "auto"
    there = {key: dataset.sha256 if key == "sha256" else getattr(dataset.recipe, key) for key in asked}
    wrong = [f"{_SAID.get(key, key)} is {there[key]!r}, not {value!r}" for key, value in asked.items()
             if there[key] != value]
    if wrong:
        raise TaskError(f"the dataset in {place} is not the one of task {task.name}: {'; '.join(wrong)}. This makes "
                        f"the right one:\n\n  {task.dataset.command()}\n")
    for split in (task.protocol.train, task.protocol.test) if not task.protocol.folds else ():
        dataset.names(split)
    return dataset
