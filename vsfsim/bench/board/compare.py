"""Comparisons of methods over objects: the values of each object in a `vsfsim.bench.result.Result`, and paired
differences with their standard errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.bench.metrics import METRICS, object_of, object_ratios

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


def by_object(result: Any, metric: str, shot: str) -> dict[str, float]:
    """A metric of each object, mean over runs, by the object's name; {} where the result does not hold it.

    The mean of ``rmse`` is over the query touches of all runs [unit of a reading]; ``rmse_ratio`` is that of each run
    to zero (`metrics.object_ratios`), where the result keeps the true readings' sizes.

    Args:
        result: of any task. metric: a key of `vsfsim.bench.metrics.METRICS`. shot: label.
    """
    if result.values:
        return dict(result.values.get(metric, {}).get(shot, {}))
    pairs: Iterable[tuple[str, float]]
    if metric == "rmse_ratio":
        by_run: dict[int, list[dict]] = {}
        for row in result.rows:
            if row["shot"] == shot:
                by_run.setdefault(row["seed"], []).append(row)
        found = [object_ratios(rows) or {} for rows in by_run.values()]
        pairs = ((name, one[name]) for one in found for name in one if all(name in other for other in found))
    elif metric == "rmse":
        columns = (result.queries[key] for key in ("object", "shot", "n", "sse"))
        pairs = ((name, math.sqrt(sse / n)) for name, at, n, sse in zip(*columns, strict=True) if at == shot)
    else:
        rows = result.answers.get(METRICS[metric].answer.value, {})
        given = zip(*(rows[key] for key in ("object", "shot", metric)), strict=True) if metric in rows else ()
        pairs = ((name, value) for name, at, value in given if at == shot and value is not None)
    values: dict[str, list[float]] = {}
    for name, value in pairs:
        values.setdefault(object_of(name), []).append(value)
    return {name: math.fsum(of) / len(of) for name, of in values.items()}


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
    found = paired(values, dict.fromkeys(values, 0.0))
    return found.mean, found.error


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
