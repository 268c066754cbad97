"""Comparisons of methods over objects: the values of each object in a `vsfsim.bench.result.Result`, and paired
differences with their standard errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.bench.metric_functions import object_of, object_ratios
from vsfsim.bench.metrics import METRICS

TOLD_APART = 2.0
"""Standard errors by which a paired difference must exceed zero before two methods count as different."""

FEWEST_OBJECTS = 3
"""With fewer objects in common nothing is told apart."""

ByObject = Mapping[str, float]


@dataclass(frozen=True)
class Paired:
    """The difference of two methods, object by object."""

    mean: float
    """Mean over objects of the first method's value minus the second's."""
    error: float
    """Standard error of that mean over objects; NaN for fewer than two objects. What one training shares between its
    objects is not in it."""
    objects: int
    """Number of objects."""

    @property
    def told_apart(self) -> bool:
        """Whether the difference exceeds `TOLD_APART` standard errors."""
        return self.objects >= FEWEST_OBJECTS and abs(self.mean) > TOLD_APART * self.error


def ratios(result: Any, shot: str) -> dict[str, float]:
    """Mean over runs of each object's ratio to zero (`metric_functions.object_ratios`), by the object's name.

    {} where the result does not hold the shot, or not the true readings' sizes.
    """
    by_run: dict[int, list[dict]] = {}
    for row in result.rows():
        if row["shot"] == shot:
            by_run.setdefault(row["seed"], []).append(row)
    found = [object_ratios(rows) for rows in by_run.values()]
    known = [one for one in found if one is not None]
    if not known or len(known) != len(found):
        return {}
    return {name: math.fsum(one[name] for one in known) / len(known) for name in known[0]
            if all(name in one for one in known)}


def absolute(result: Any, shot: str, *, scale: float = 1.0) -> dict[str, float]:
    """Mean over runs and query touches of the error of each object [unit of a reading], by the object's name.

    Args:
        result: of any task. shot: label. scale: factor on every error.
    """
    sums: dict[str, list[float]] = {}
    for name, at, n, sse in zip(*(result.queries[k] for k in ("object", "shot", "n", "sse")), strict=True):
        if at == shot:
            sums.setdefault(object_of(name), []).append(math.sqrt(sse / n))
    return {name: scale * math.fsum(values) / len(values) for name, values in sums.items()}


def by_object(result: Any, metric: str, shot: str) -> dict[str, float]:
    """A metric of each object, mean over runs, by the object's name; {} where the result does not hold it.

    Args:
        result: of any task. metric: a key of `vsfsim.bench.metrics.METRICS`. shot: label.
    """
    if result.values:
        return dict(result.values.get(metric, {}).get(shot, {}))
    if metric == "rmse_ratio":
        return ratios(result, shot)
    if metric == "rmse":
        return absolute(result, shot)
    rows = result.answers.get(METRICS[metric].answer.value, {})
    if metric not in rows:
        return {}
    found: dict[str, list[float]] = {}
    for name, at, value in zip(*(rows.get(key, ()) for key in ("object", "shot", metric)), strict=True):
        if at == shot and value is not None:
            found.setdefault(object_of(name), []).append(value)
    return {name: math.fsum(v) / len(v) for name, v in found.items()}


def paired(one: ByObject, other: ByObject) -> Paired:
    """The paired difference of two methods over the objects that both have.

    Args:
        one, other: values by object.
    """
    names = sorted(one.keys() & other.keys())
    difference = np.array([one[name] - other[name] for name in names])
    n = len(difference)
    if not n:
        return Paired(math.nan, math.nan, 0)
    return Paired(float(difference.mean()), float(difference.std(ddof=1) / math.sqrt(n)) if n > 1 else math.nan, n)


def interval(values: ByObject) -> tuple[float, float]:
    """Mean over objects and its standard error (NaN for one object)."""
    array = np.array(list(values.values()), float)
    if not len(array):
        return math.nan, math.nan
    return float(array.mean()), float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else math.nan


def joined_ranks(values: Sequence[ByObject]) -> list[int]:
    """Ranks from 1 of methods in ascending order of their mean, equal where they cannot be told apart.

    A method shares the rank of the best method of the rank before it unless its paired difference from that one
    exceeds `TOLD_APART` standard errors. Ranks go on as in a race: 1, 1, 3.

    Args:
        values: by object, one a method, sorted by their mean.
    """
    ranks: list[int] = []
    first = 0
    for k, mine in enumerate(values):
        if k and not paired(mine, values[first]).told_apart:
            ranks.append(ranks[first])
        else:
            first = k
            ranks.append(k + 1)
    return ranks
