"""A task: data, protocol, observation and metric, as a versioned TOML file that never changes once released."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from vsfsim.bench.metrics import METRICS, Metric
from vsfsim.bench.noise import NOISE_KINDS, SIGNED, Noise
from vsfsim.bench.observations import Observation, observation
from vsfsim.core.errors import DatasetError, TaskError, did_you_mean
from vsfsim.core.shelf import datasets, find_task
from vsfsim.core.table import Table, parse_toml, read_text
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import text_sha256

ALL = "all"
"""The shot that means every touch which is not a query."""

DEVELOPMENT = "development"
"""The name of a task on its development objects ends in it."""

OTHERS = re.compile(r"(.+)-(development|seed-\d+)")
"""Name of a task on other objects than its own (`Task.on`)."""

_NOT_COUNTED = re.compile(r'(?m)^(superseded_by *=|unresolved *= *"scored").*\n')
"""Lines that the sha256 of a task is not of: tasks were released before they said that unresolved frames count."""


@dataclass(frozen=True)
class DatasetWanted:
    """``[dataset]``: which dataset the task needs, and how to make it."""

    folder: str
    """Its place under ``datasets/``."""
    scene: str
    """Name of the scene."""
    scene_sha256: str
    """Of the scene's text, or "" for any."""
    seed: int
    """Of the recipe."""
    objects: int
    """Of the recipe."""
    views: int
    """Of each object."""
    touches: int
    """Of each view."""
    tier: str
    """Of the recipe, or "auto" for any."""
    sha256: str
    """Of the content, or "" for any."""

    def path(self) -> Path:
        """Where it is looked for: under $VSFSIM_DATASETS, else under ./datasets."""
        return datasets() / self.folder

    def command(self, out: Path | None = None) -> str:
        """The command that makes it, quoted for a shell."""
        counts = f"--objects {self.objects} --views {self.views} --touches {self.touches} --seed {self.seed}"
        return shlex.join(["vsfsim", "generate", self.scene, *counts.split(), "--tier", self.tier,
                           "--out", str(out or self.path())])


@dataclass(frozen=True)
class Protocol:
    """``[protocol]``: the few-shot protocol, with two fixed splits, or with cross-validation over objects (``folds``).

    With cross-validation a run is one training and one draw of the support sets: run = training x draws + draw. A
    method without a ``seed`` has one training.
    """

    train: str
    """Name of the split that methods learn from; "" with cross-validation."""
    test: str
    """Name of the split that is scored; "" with cross-validation."""
    shots: tuple[int, ...]
    """Sizes of the support set, increasing."""
    seeds: int
    """Number of runs: of draws of the support set; with cross-validation, of trainings times draws."""
    query: int
    """Number of query touches of each test object, the same for every shot and seed."""
    seed: int
    """Root of all draws, >= 0."""
    folds: int = 0
    """Parts into which the objects are divided, each of them tested once; 0 for the two splits above."""
    draws: int = 0
    """With cross-validation, draws of the support set; else 0."""
    trainings: int = 0
    """With cross-validation, trainings of a method with a ``seed``, each with another seed; else 0."""
    chosen: bool = False
    """A method with `choose` names its support touches itself, one after the other; others are given the drawn ones."""
    unresolved: bool = False
    """Frames are scored whose contact the mesh does not resolve (`vsfsim.data.records.Touch.resolved`)."""
    transfer: bool = False
    """Queries are the presses of other kinds than the scene's own (``[[touches.other]]``), and only its own are learned
    from, on training objects as well."""

    def runs(self, *, seeded: bool) -> tuple[int, ...]:
        """Numbers of the runs of a method that takes a ``seed``, or does not."""
        return tuple(range(self.draws if self.folds and not seeded else self.seeds))

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
class PaperRow:
    """``[[paper]]``: a row of a table in the literature, shown beside ours."""

    method: str
    """As the paper calls it."""
    source: str
    """Paper and table."""
    unit: str
    """Of its numbers."""
    comparable: bool
    """False where the data or the quantity differ, so that the numbers are context only."""
    values: Mapping[str, tuple[float, float | None]]
    """(mean, standard deviation or None) by shot label, in ``unit``."""


@dataclass(frozen=True)
class Task:
    """One task."""

    name: str
    """With its version."""
    description: str
    """One sentence."""
    superseded_by: str
    """Name of the task that corrects this one, or ""."""
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
    paper: tuple[PaperRow, ...]
    """Rows of the literature."""
    sha256: str
    """Of the task file's text without the line of ``superseded_by``, so that results stay valid when a task is
    superseded."""

    @property
    def metric(self) -> Metric:
        """The row of `primary` in the table of metrics."""
        return METRICS[self.primary]

    def on(self, objects: str) -> Task:
        """The same questions on other objects, as a task of its own: its results are no rows of this one.

        Args:
            objects: "development"; or "seed-N", as many objects of the recipe's seed N.

        Raises:
            TaskError: it is neither; the seed is one of the task's own, or the task names no development objects.
        """
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
        return replace(self, name=f"{self.name}-{objects}", dataset=wanted, development=None, paper=(),
                       description=f"{self.description} On {objects} objects; never ranked.",
                       sha256=text_sha256(f"{self.sha256}-{objects}"))


def load_task(given: str | Path) -> Task:
    """The task of this name, or in this TOML file. TASK-development and TASK-seed-N are TASK on other objects
    (`Task.on`).

    Raises:
        TaskError: there is no such task, it is not TOML, a key is unknown or missing, or a value is out of range.
    """
    others = OTHERS.fullmatch(str(given))
    if others is not None:
        return load_task(others[1]).on(others[2])
    path = find_task(str(given))
    return parse_task(read_text(path, "task", TaskError), path)


def parse_task(text: str, path: str | Path) -> Task:
    """Like `load_task`, from text; ``path`` names it in messages."""
    tree = parse_toml(text, Path(path), "task", TaskError)
    top = Table(tree, str(path), ("name", "description", "superseded_by", "dataset", "protocol", "observation",
                                  "noise", "metrics", "paper"), error=TaskError)
    name = top.text("name")
    if not re.fullmatch(r"[a-z0-9-]+-v\d+", name):
        raise TaskError(f"{path}: name is {name!r}; a task's name ends in its version, e.g. fewshot-shoes-v3-mini-v1.")
    d = top.section("dataset", ("folder", "scene", "scene_sha256", "seed", "objects", "views", "touches", "tier",
                              "sha256", "development"))
    wanted = DatasetWanted(d.text("folder"), d.text("scene"), d.text("scene_sha256", ""),
                           d.count("seed", None, 0), d.count("objects", None, 1), d.count("views", None, 1),
                           d.count("touches", None, 1), d.text("tier", "auto"), d.text("sha256", ""))
    development = None
    if "development" in d.table:
        o = Table(d.table["development"], f"{d.where} development", ("folder", "seed", "objects"), error=TaskError)
        development = replace(wanted, folder=o.text("folder"), seed=o.count("seed", None, 0),
                              objects=o.count("objects", None, 1), sha256="")
        if development.seed == wanted.seed or development.folder == wanted.folder:
            raise TaskError(f"{o.where}: seed {development.seed} and folder '{development.folder}' must both differ "
                            f"from those of [dataset], so that no object is in both.")
    protocol = _protocol(top.section("protocol", ("train", "test", "shots", "seeds", "query", "seed", "folds", "draws",
                                                  "trainings", "support", "transfer", "unresolved")))
    o = top.section("observation", ("kind",))
    noise = _noise(top.section("noise", ("kind", *(f.name for f in fields(Noise)))))
    m = top.section("metrics", ("primary", "ranking_shot"))
    primary, ranking = m.text("primary"), str(m.need("ranking_shot"))
    rankable = [name for name, metric in METRICS.items() if metric.ranks]
    if primary not in rankable:
        raise TaskError(f"{m.where}: primary is '{primary}'. {did_you_mean(primary, rankable)}")
    if ranking not in protocol.labels:
        raise TaskError(f"{m.where}: ranking_shot is {ranking}; it must be one of the shots: "
                        f"{', '.join(protocol.labels)}.")
    paper = tuple(_paper(Table(row, f"{path} [[paper]] {i + 1}", ("method", "source", "unit", "comparable", "values"),
                               error=TaskError), protocol) for i, row in enumerate(top.rows("paper")))
    return Task(name, top.text("description"), top.text("superseded_by", ""), wanted, development, protocol,
                observation(o.text("kind"), o.where), noise, primary, ranking, paper,
                text_sha256(_NOT_COUNTED.sub("", text) + ("" if protocol.unresolved else "unresolved left out")))


def open_dataset(task: Task, path: str | Path | None = None) -> Dataset:
    """The task's dataset, checked against what the task wants.

    Args:
        task: the task. path: folder, or None for `DatasetWanted.path`.

    Raises:
        TaskError: the dataset is missing (with the command that makes it), or is another one.
        DatasetError: it is damaged.
    """
    folder = task.dataset.path() if path is None else Path(path)
    try:
        dataset = Dataset.open(folder)
    except DatasetError as error:
        if (folder / "dataset.json").exists():
            raise
        raise TaskError(f"task {task.name}: {error} This makes it:\n\n  {task.dataset.command(folder)}\n") from error
    recipe, want = dataset.recipe, task.dataset
    pairs = [("scene", recipe.scene, want.scene), ("seed", recipe.seed, want.seed),
             ("objects", recipe.objects, want.objects),
             ("views", recipe.views, want.views), ("touches", recipe.touches, want.touches)]
    if want.tier != "auto":  # a recipe names the tier that was chosen, never "auto"
        pairs.append(("tier", recipe.tier, want.tier))
    if want.scene_sha256:
        pairs.append(("sha256 of the scene text", recipe.scene_sha256, want.scene_sha256))
    if want.sha256:
        pairs.append(("sha256 of the content", dataset.sha256, want.sha256))
    wrong = [f"{key} is {there!r}, not {asked!r}" for key, there, asked in pairs if there != asked]
    if wrong:
        raise TaskError(f"the dataset in {folder} is not the one of task {task.name}: {'; '.join(wrong)}. This makes "
                        f"the right one:\n\n  {task.dataset.command()}\n")
    for split in (task.protocol.train, task.protocol.test) if not task.protocol.folds else ():
        dataset.names(split)
    return dataset


def _protocol(t: Table) -> Protocol:
    shots = t.need("shots")
    if (not isinstance(shots, list) or not shots or sorted(set(shots)) != shots
        or any(isinstance(k, bool) or not isinstance(k, int) or k < 0 for k in shots)):
        raise TaskError(f"{t.where}: shots is {shots!r}; give increasing whole numbers, e.g. [0, 1, 5, 10].")
    query, seed, given = t.count("query", None, 1), t.count("seed", None, 0), t.text("support", "drawn")
    more: dict[str, bool] = {"transfer": t.flag("transfer", False), "chosen": given == "chosen",
                             "unresolved": t.word("unresolved", "left out", ("left out", "scored")) == "scored"}
    if given not in ("drawn", "chosen"):
        raise TaskError(f"{t.where}: support is '{given}'; it is drawn (at random) or chosen (by the method).")
    if "folds" not in t.table:
        odd = [key for key in ("draws", "trainings") if key in t.table]
        if odd:
            raise TaskError(f"{t.where}: {odd[0]} belongs to cross-validation; give folds too, or give train, test and "
                            f"seeds without it.")
        return Protocol(t.text("train", "train"), t.text("test", "test"), tuple(shots), t.count("seeds", None, 1),
                        query, seed, **more)
    odd = [key for key in ("train", "test", "seeds") if key in t.table]
    if odd:
        raise TaskError(f"{t.where}: {odd[0]} and folds exclude each other. With cross-validation every object is a "
                        f"test object once; give folds, draws and trainings.")
    draws, trainings = t.count("draws", None, 1), t.count("trainings", None, 1)
    return Protocol("", "", tuple(shots), draws * trainings, query, seed, t.count("folds", None, 2), draws, trainings,
                    **more)


def _noise(t: Table) -> Noise:
    kind = t.text("kind", "")
    if kind and kind not in NOISE_KINDS:
        raise TaskError(f"{t.where}: kind is '{kind}'. {did_you_mean(kind, NOISE_KINDS)}")
    preset = NOISE_KINDS.get(kind, {})
    values: dict[str, Any] = {}
    for f in fields(Noise):
        if f.name in ("tare_frames", "seed"):
            values[f.name] = t.count(f.name, None, 0)
            continue
        # without a kind the white noise of the force must be given
        without_kind: Any = {"offset_std": 0.0, "drift_std": 0.0, "force_std": None}
        default: Any = preset.get(f.name, without_kind.get(f.name, f.default))
        values[f.name] = t.number(f.name, default, -1e9 if f.name in SIGNED else 0.0, 1e9)
    if not values["relaxation_time"] > 0.0:
        raise TaskError(f"{t.where}: relaxation_time is 0; it must be greater than 0, in seconds.")
    return Noise(**values)


def _paper(t: Table, protocol: Protocol) -> PaperRow:
    values = t.need("values")
    out: dict[str, tuple[float, float | None]] = {}
    for label, value in (values.items() if isinstance(values, Mapping) else ()):
        if label not in protocol.labels:
            raise TaskError(f"{t.where}: values names shot '{label}'. {did_you_mean(label, protocol.labels)}")
        numbers = value if isinstance(value, list) else [value]
        if len(numbers) not in (1, 2) or not all(isinstance(x, (int, float)) for x in numbers):
            raise TaskError(f"{t.where}: values.{label} is {value!r}; give a mean, or [mean, std].")
        out[label] = (float(numbers[0]), float(numbers[1]) if len(numbers) == 2 else None)
    comparable = t.need("comparable")
    if not isinstance(comparable, bool) or not out:
        raise TaskError(f"{t.where}: comparable must be true or false and values a table, e.g. "
                        f"{{ 0 = [8.27, 0.00], all = 4.10 }}.")
    return PaperRow(t.text("method"), t.text("source"), t.text("unit"), comparable, out)
