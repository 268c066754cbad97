"""Whether a claim holds: paired differences over objects, with trainings as a second random effect, and Holm's
correction over all claims.

With d the difference of two sides, one number an object, its mean has the variance

    var(d) / n + sum over the sides of (spread between trainings)^2 / trainings

The degrees of freedom are Satterthwaite's (1946). *Direction*: a claim that one side errs less is a two-sided t test
of d against 0, a claim that two sides are equal one of |d| against a margin (an equivalence test and its reverse,
Schuirmann 1987): more data can prove either answer. *Size*: our improvement over the worse side's value is tested
against half of the paper's. All tests of all claims are one family (Holm 1979).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from vsfsim.bench.board.compare import FEWEST_OBJECTS, ByObject, paired

HOLDS, FAILS, UNTOLD = "holds", "does not hold", "cannot be told"

LEVEL = 0.05
"""Probability of one or more wrong answers among all claims."""

EQUAL_WITHIN = 0.15
"""Two sides are equal if they differ by less than this share of the second one."""


@dataclass(frozen=True)
class Values:
    """One side of a claim."""

    objects: ByObject
    """The metric of each object, mean over runs."""
    spread: float = 0.0
    """Standard deviation of the mean over objects between runs [as the metric]."""
    runs: int = 1
    """Runs over which it was taken."""
    trainings: int = 0
    """Trainings among them; 0 for a method without random numbers."""

    def variance(self) -> float:
        """What trainings add to the variance of the mean. The draws of a training are equal or count as trainings, so
        that it is not too small."""
        t = self.trainings
        return self.spread**2 * (self.runs - 1) / (self.runs / t * (t - 1)) / t if t > 1 else 0.0


@dataclass(frozen=True)
class Difference:
    """The difference of two sides, the better minus the worse as claimed."""

    mean: float
    """Over objects [as the metric]."""
    error: float
    """Its standard error, trainings included."""
    objects: int
    """Objects in common."""
    freedom: float
    """Degrees of freedom of the error."""
    trainings: int
    """The fewest trainings of a side that has any; 0 where neither has."""
    level: float
    """Mean of the worse side."""

    @classmethod
    def of(cls, better: Values, worse: Values) -> Difference:
        """From both sides."""
        found = paired(better.objects, worse.objects)
        level = float(np.mean([worse.objects[k] for k in better.objects.keys() & worse.objects.keys()] or [math.nan]))
        own = [found.error**2, better.variance(), worse.variance()]
        of = [found.objects - 1, better.trainings - 1, worse.trainings - 1]
        total, below = sum(own), sum(v**2 / f for v, f in zip(own, of) if v > 0.0 and f > 0)
        return cls(found.mean, math.sqrt(total) if total == total else math.nan, found.objects,
                   total**2 / below if below > 0.0 else math.inf, min((v.trainings for v in (better, worse)
                                                                       if v.trainings), default=0), level)

    def probability(self, value: float, against: float) -> float:
        """Two-sided probability of ``value`` at least as far from ``against`` by chance."""
        if self.objects < FEWEST_OBJECTS or not self.error >= 0.0:
            return 1.0
        if self.error == 0.0:
            return 1.0 if value == against else 0.0
        return float(2.0 * stats.t.sf(abs(value - against) / self.error, self.freedom))

    def half_width(self) -> float:
        """Of the interval that has the mean with 95 % [as the metric]."""
        return float(stats.t.ppf(0.975, self.freedom)) * self.error


@dataclass(frozen=True)
class Answers:
    """What is told of a claim."""

    direction: str
    """`HOLDS`, `FAILS` or `UNTOLD`."""
    size: str
    """The same; "" where the paper prints no figures, or claims equality."""
    chance: tuple[float, float]
    """Probabilities of both, corrected by Holm's method."""


@dataclass(frozen=True)
class Question:
    """A claim as it is tested."""

    difference: Difference | None
    """None where a result is missing."""
    equal: bool
    """The claim is that the sides are equal."""
    higher: bool
    """A higher value of the metric is better."""
    share: float | None
    """The paper's improvement over the worse side's value [-]; None without figures."""

    @property
    def has_size(self) -> bool:
        """Whether the paper's figures say by how much."""
        return not self.equal and self.share is not None

    def tests(self) -> list[tuple[float, bool]]:
        """Probability by chance, and whether the data are on the claim's side: of the direction, and of a size if there
        is one; [] where a result is missing."""
        d = self.difference
        if d is None:
            return []
        if self.equal:
            margin = EQUAL_WITHIN * abs(d.level)
            return [(d.probability(abs(d.mean), margin), abs(d.mean) < margin)]
        gain = d.mean if self.higher else -d.mean
        least = [0.0] if self.share is None else [0.0, 0.5 * self.share * abs(d.level)]
        return [(d.probability(gain, one), gain > one) for one in least]


def answers(asked: Sequence[Question]) -> list[Answers]:
    """The answers to all questions, which are one family."""
    tests = [one.tests() for one in asked]
    chance = iter(holm([p for row in tests for p, _ in row]))
    out = []
    for one, row in zip(asked, tests, strict=True):
        told = [(UNTOLD if p > LEVEL else HOLDS if own else FAILS, p) for (_, own), p in zip(row, chance)]
        (direction, p), (size, q) = [*told, *[(UNTOLD, 1.0)] * (2 - len(told))]
        out.append(Answers(direction, size if one.has_size else "", (p, q)))
    return out


def holm(chance: Sequence[float]) -> list[float]:
    """Probabilities corrected by Holm's method, in the order given."""
    order, out, least = sorted(range(len(chance)), key=lambda k: chance[k]), [1.0] * len(chance), 0.0
    for rank, k in enumerate(order):
        least = max(least, min(1.0, (len(chance) - rank) * chance[k]))
        out[k] = least
    return out
