"""What a method learns from, and which objects are scored, where a study departs from its task's own division.

The draws come from `SeedSequence(protocol.seed, spawn_key=...)`: the order of a fold's training objects from (3, fold,
training), that of an object's touches from (4, object, view, training). A share takes the first of that order, so that
a smaller share is a part of a larger one.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vsfsim.bench.method import Specimen
from vsfsim.bench.protocol import Fold, folds_of
from vsfsim.bench.task import Protocol, Task
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.data.dataset import Dataset
from vsfsim.data.manifest import Entry

RULES = {"others": "the objects of the other folds, as the task says",
         "same-class": "all other objects of the test object's class",
         "other-classes": "all objects of other classes than the test object's",
         "same-object": "the other views of the test object"}
"""What a method learns from before it meets a test object."""


@dataclass(frozen=True)
class Extra:
    """Objects of another dataset that are training objects of every fold, too."""

    task: Task
    """Whose noise and observation their readings have."""
    dataset: Dataset
    """Where they are."""
    objects: int
    """How many of them, the first ones."""


@dataclass(frozen=True)
class Training:
    """The default is what the task says."""

    rule: str = "others"
    """A key of `RULES`."""
    objects: float = 1.0
    """Share of the training objects that a method gets, at least one object [-]."""
    touches: float = 1.0
    """Share of the touches of each of them, at least one touch [-]."""
    train_views: tuple[int, ...] = ()
    """Numbers of the views of training objects; () for all."""
    test_views: tuple[int, ...] = ()
    """Numbers of the views that are scored; () for all."""
    extra: tuple[Extra, ...] = ()
    """Further training objects."""

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise TaskError(f"train is '{self.rule}'. {did_you_mean(self.rule, RULES)}")
        for name, value in (("share_of_objects", self.objects), ("share_of_touches", self.touches)):
            if not 0.0 < value <= 1.0:
                raise TaskError(f"{name} is {value!r}; it must be greater than 0 and at most 1.")

    @property
    def is_plain(self) -> bool:
        """Whether it is what the task says."""
        return self == Training()

    def table(self) -> dict[str, Any]:
        """For a result file: what differs from the task's own division, {} if nothing does."""
        if self.is_plain:
            return {}
        extra = [{"task": e.task.name, "dataset_sha256": e.dataset.sha256, "objects": e.objects}
                 for e in self.extra]
        return {"train": self.rule, "share_of_objects": self.objects, "share_of_touches": self.touches,
                "train_views": list(self.train_views), "test_views": list(self.test_views), "extra": extra}

    def folds(self, dataset: Dataset, protocol: Protocol) -> tuple[Fold, ...]:
        """Which views a method learns from when which others are scored; no view is in both.

        Raises:
            TaskError: the dataset has too few objects or views for the rule, or its scene names no classes.
        """
        found = [(number, train, test) for number, (train, test) in enumerate(self._divided(dataset, protocol))]
        folds = []
        for number, train, test in found:
            learned = tuple(e.name for e in train if not self.train_views or e.view_index in self.train_views)
            scored = tuple(e.name for e in test if not self.test_views or e.view_index in self.test_views)
            if not scored:
                continue
            if not learned and not self.extra:
                raise TaskError(f"the dataset in {dataset.path} has no training view for {scored[0]} by the rule "
                                f"'{self.rule}' ({RULES[self.rule]}). Generate more objects or views.")
            folds.append(Fold(number, learned, scored))
        if not folds:
            raise TaskError(f"the dataset in {dataset.path} has none of the views {list(self.test_views)} that are "
                            f"scored. Generate more views.")
        return tuple(folds)

    def _divided(self, dataset: Dataset, protocol: Protocol) -> Sequence[tuple[list[Entry], list[Entry]]]:
        entries = list(dataset.entries)
        if self.rule == "others":
            by_name = {e.name: e for e in entries}
            return [([by_name[n] for n in f.train], [by_name[n] for n in f.test]) for f in folds_of(dataset, protocol)]
        if self.rule == "same-object":
            return [([e for e in entries if e.object_index == one.object_index and e.name != one.name], [one])
                    for one in entries]
        of = classes_of(dataset)
        if self.rule == "same-class":
            return [([e for e in entries if of[e.object_index] == of[k] and e.object_index != k],
                     [e for e in entries if e.object_index == k]) for k in of]
        return [([e for e in entries if of[e.object_index] != kind], [e for e in entries if of[e.object_index] == kind])
                for kind in dict.fromkeys(of.values())]

    def specimens(self, task: Task, dataset: Dataset, fold: Fold, training: int,
                  read: Callable[[Task, Dataset, str], Specimen]) -> list[Specimen]:
        """The training objects of one training, as a method receives them.

        Args:
            task, dataset: of the evaluation. fold: whose training views. training: its number. read: what reads an
            object view by its name (`vsfsim.bench.trials.answers.Reader.specimen`).
        """
        number = {e.name: e.object_index for e in dataset.entries}
        objects = sorted({number[name] for name in fold.train})
        if self.objects < 1.0:
            order = _order(len(objects), task.protocol.seed, (3, fold.number, training))
            objects = [objects[k] for k in order[:max(1, round(self.objects * len(objects)))]]
        out = [read(task, dataset, name) for name in fold.train if number[name] in objects]
        views = {e.name: e.view_index for e in dataset.entries}
        if self.touches < 1.0:
            out = [self._some(s, task.protocol.seed, (4, number[s.name], views[s.name], training)) for s in out]
        for extra in self.extra:
            out += [read(extra.task, extra.dataset, e.name) for e in extra.dataset.entries
                    if e.object_index < extra.objects]
        return out

    def _some(self, given: Specimen, seed: int, key: tuple[int, ...]) -> Specimen:
        order = sorted(_order(len(given.touches), seed, key)[:max(1, round(self.touches * len(given.touches)))])
        return replace(given, touches=tuple(given.touches[k] for k in order))


PLAIN = Training()
"""What the task says."""


def classes_of(dataset: Dataset) -> dict[int, str]:
    """Class of each object by its number: the style that the dataset's scene names for it.

    Raises:
        TaskError: it names none.
    """
    tree: Any = tomllib.loads(dataset.recipe.scene_text)
    for key in ("object", "shape", "style", "each"):
        tree = tree.get(key, {}) if isinstance(tree, dict) else {}
    if not tree:
        raise TaskError(f"the scene of the dataset in {dataset.path} names no classes ([object.shape] style = "
                        f"{{ each = [...] }}), so its objects have none.")
    return {index: str(tree[index % len(tree)]) for index in sorted({e.object_index for e in dataset.entries})}


def _order(count: int, seed: int, key: tuple[int, ...]) -> list[int]:
    return [int(k) for k in np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key)).permutation(count)]
