"""Comparisons of methods over objects: the values of each object in every run of a `vsfsim.bench.result.Result`, the
area under their curve over touches, and paired differences with their errors.

The error of a mean is what three bootstraps add up to, one over the objects, one over the trainings and one over the
draws of the support sets, each with one fewer than there are (McCarthy and Snowden 1985). For a mean that is a closed
form: the variance of the means of each kind over their number. What objects and runs do together is in all three, so
that the error is rather too large. The degrees of freedom of the t interval are Satterthwaite's (1946).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from vsfsim.bench.metrics import METRICS, object_of, score_of_rows
from vsfsim.bench.task import ALL, Task

LEVEL = 0.05
"""Probability by chance at which two methods count as different."""
FEWEST_OBJECTS = 3
"""With fewer objects in common nothing is told apart."""
AREA = "area"
"""The name of the area among the shots."""

ByObject = Mapping[str, float]
Runs = Mapping[str, np.ndarray]
"""By object: its value in each training and draw (trainings, draws)."""


@dataclass(frozen=True)
class Paired:
    """The difference of two methods, object by object, training by training and draw by draw."""

    mean: float
    """Over objects and runs of the first method's value minus the second's."""
    error: float
    """Its standard error over objects, trainings and draws; NaN for fewer than two objects."""
    objects: int
    """Number of objects."""
    freedom: float
    """Degrees of freedom of the error."""
    level: float
    """Mean of the second method."""

    def chance(self, against: float = 0.0) -> float:
        """Two-sided probability of a mean at least as far from ``against`` by chance."""
        if self.objects < FEWEST_OBJECTS:
            return 1.0
        if self.error == 0.0:
            return float(self.mean == against)
        return float(2.0 * special.stdtr(self.freedom, -abs(self.mean - against) / self.error))

    @property
    def half_width(self) -> float:
        """Of the interval that has the mean with 95 %."""
        return float(special.stdtrit(self.freedom, 1.0 - 0.5 * LEVEL)) * self.error

    @property
    def told_apart(self) -> bool:
        """Whether the two differ, by this pair alone."""
        return self.chance() <= LEVEL


def by_run(result: Any, metric: str, shot: str, draws: int = 1) -> dict[str, np.ndarray]:
    """A metric of each object in each run, by the object's name; {} where the result does not hold it.

    It is what the metric gives of the rows of one object (`metrics.score_of_rows`).

    Args:
        result: of any task. metric: a key of `vsfsim.bench.metrics.METRICS`. shot: label. draws: of each training.
    """
    found: dict[str, Sequence[float | None]] = {}
    if result.values:
        known = result.values.get(metric, {}).get(shot, {})
        found = {name: of if isinstance(of, list | tuple) else [of] for name, of in known.items()}
    else:
        rows, cells = result.rows_of(METRICS[metric].answer), dict[str, dict[int, list[Any]]]()
        for row in rows:
            if row["shot"] == shot:
                cells.setdefault(object_of(row["object"]), {}).setdefault(row["seed"], []).append(row)
        found = {name: [score_of_rows(METRICS[metric], of[run]) if run in of else None for run in result.seeds]
                 for name, of in cells.items()}
    out = {name: np.array(of, float) for name, of in found.items()}  # None becomes NaN
    return {name: of.reshape(-1, draws if len(of) % draws == 0 else len(of)) for name, of in out.items()
            if np.isfinite(of).any()}


def means(values: Runs) -> dict[str, float]:
    """The mean of each object over its runs."""
    return {name: float(np.nanmean(of)) for name, of in values.items()}


def by_object(result: Any, metric: str, shot: str) -> dict[str, float]:
    """A metric of each object, mean over runs; operands as of `by_run`."""
    return means(by_run(result, metric, shot))


def shares(task: Task) -> dict[str, float]:
    """The share of each shot in the area under a task's curve, by label.

    The area is the mean height of the curve from the fewest touches to all, by trapezoids over log2(1 + touches), so
    that each doubling of the touches counts alike whatever shots a task lists. All are the touches that are no queries.
    """
    touches = task.dataset.touches
    most = -(-touches // 2) if task.protocol.transfer else touches - task.protocol.query  # every second is a query
    at = np.log2(1.0 + np.maximum.accumulate([*task.protocol.shots, most]))
    steps = np.diff(at) if at[-1] > at[0] else np.ones(len(at) - 1)
    half = 0.5 * steps / steps.sum()
    return dict(zip((*map(str, task.protocol.shots), ALL), np.append(half, 0.0) + np.append(0.0, half), strict=True))


def curve(result: Any, task: Task) -> dict[str, Runs]:
    """A task's metric by shot, and the area under it (`AREA`); of a result that lacks a shot, without the area."""
    found: dict[str, Runs] = {label: by_run(result, task.primary, label, task.protocol.draws or len(result.seeds))
                              for label in task.protocol.labels}
    names = set.intersection(*map(set, found.values()))
    parts = [(share, found[label]) for label, share in shares(task).items()]
    return {**found, AREA: {name: np.sum([share * of[name] for share, of in parts], axis=0) for name in sorted(names)}}


def paired(one: Runs, other: Runs) -> Paired:
    """The paired difference of two methods over the objects that both have. A method without trainings, or with equal
    ones, is compared with each training of the other.

    Args:
        one, other: values by object.
    """
    names = sorted(one.keys() & other.keys())
    n = len(names)
    if not n:
        return Paired(math.nan, math.nan, 0, math.nan, math.nan)
    known = (np.stack([of[name] for name in names]) for of in (one, other))
    sides = [np.where(np.isfinite(of), of, np.nanmean(of, axis=(1, 2), keepdims=True)) for of in known]
    least = [min((side.shape[axis] for side in sides if side.shape[axis] > 1), default=1) for axis in (1, 2)]
    left, right = (side[:, :least[0], :least[1]] for side in sides)
    d = left - right
    spread = [(of.var(ddof=1) / len(of), len(of) - 1) for axes in ((1, 2), (0, 2), (0, 1))
              if len(of := d.mean(axis=axes)) > 1]
    total, below = sum(v for v, _ in spread), sum(v**2 / f for v, f in spread)
    return Paired(float(d.mean()), math.sqrt(total) if n > 1 else math.nan, n,
                  total**2 / below if below > 0.0 else math.inf, float(right.mean()))


def interval(values: Runs) -> Paired:
    """Mean over objects and runs, with its standard error (NaN for one object)."""
    return paired(values, {name: np.zeros((1, 1)) for name in values})


def holm(chance: Sequence[float]) -> list[float]:
    """Probabilities corrected for their number by Holm's method (1979), in the order given."""
    order, out, least = sorted(range(len(chance)), key=lambda k: chance[k]), [1.0] * len(chance), 0.0
    for rank, k in enumerate(order):
        least = max(least, min(1.0, (len(chance) - rank) * chance[k]))
        out[k] = least
    return out


def ranks(values: Sequence[Runs]) -> list[int]:
    """Ranks from 1 of methods in the order of their means: no two methods of a rank differ by their paired difference,
    at the level `LEVEL` over all pairs of methods together (`holm`). Ranks go on as in a race: 1, 1, 3.

    Args:
        values: by object, one a method, the best first.
    """
    pairs = list(itertools.combinations(range(len(values)), 2))
    chance = dict(zip(pairs, holm([paired(values[i], values[k]).chance() for i, k in pairs]), strict=True))
    out, first = [], 0
    for k in range(len(values)):
        if any(chance[i, k] <= LEVEL for i in range(first, k)):
            first = k
        out.append(first + 1)
    return out


def wins(values: Sequence[Runs], sign: float = 1.0) -> list[float]:
    """Of each of some methods, the share of the objects on which it errs less than another one, mean over these; a tie
    is half. NaN for one method alone.

    Args:
        values: by object, one a method. sign: -1 where a higher value is better.
    """
    tables = [means(of) for of in values]
    out = []
    for k, mine in enumerate(tables):
        told = [0.5 + 0.5 * np.sign(sign * (of[name] - mine[name])) for i, of in enumerate(tables) if i != k
                for name in mine.keys() & of.keys()]
        out.append(float(np.mean(told)) if told else math.nan)
    return out
