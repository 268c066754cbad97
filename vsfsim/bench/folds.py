"""Cross-validation over objects: which objects a method learns from when which others are scored.

Every object of the dataset is a test object exactly once, and all views of an object are in the same fold. The draw
comes from `SeedSequence(protocol.seed, spawn_key=(2,))`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.bench.task import Protocol
from vsfsim.core.errors import TaskError
from vsfsim.data.dataset import Dataset


@dataclass(frozen=True)
class Fold:
    """One division of a dataset's object views."""

    number: int
    """From 0."""
    train: tuple[str, ...]
    """Names of the views that methods learn from."""
    test: tuple[str, ...]
    """Names of the views that are scored."""


def folds_of(dataset: Dataset, protocol: Protocol) -> tuple[Fold, ...]:
    """The folds of a task; one fold, of its two splits, for a task without cross-validation.

    Raises:
        TaskError: there are fewer objects than folds.
    """
    if not protocol.folds:
        return (Fold(0, tuple(dataset.names(protocol.train)), tuple(dataset.names(protocol.test))),)
    objects = np.array(sorted({entry.object_index for entry in dataset.entries}), dtype=int)
    if len(objects) < protocol.folds:
        raise TaskError(f"the dataset in {dataset.path} has {len(objects)} objects, and the task divides them into "
                        f"{protocol.folds} folds. Generate more objects, or lower folds in a task of your own.")
    order = np.random.default_rng(np.random.SeedSequence(protocol.seed, spawn_key=(2,))).permutation(objects)
    number = {int(index): place % protocol.folds for place, index in enumerate(order)}
    return tuple(Fold(k, tuple(e.name for e in dataset.entries if number[e.object_index] != k),
                      tuple(e.name for e in dataset.entries if number[e.object_index] == k))
                 for k in range(protocol.folds))


def test_names(dataset: Dataset, protocol: Protocol) -> tuple[str, ...]:
    """Names of all object views that are scored, fold by fold."""
    return tuple(name for fold in folds_of(dataset, protocol) for name in fold.test)


def shown_names(dataset: Dataset, protocol: Protocol) -> tuple[str, ...]:
    """Names of all object views that a method meets, training objects first; each once."""
    folds = folds_of(dataset, protocol)
    return tuple(dict.fromkeys([*(n for f in folds for n in f.train), *(n for f in folds for n in f.test)]))
