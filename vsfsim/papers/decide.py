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

HOLDS, FAILS, UNTOLD, NONE = "holds", "does not hold", "cannot be told", ""

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
    """The same; `NONE` where the paper prints no figures, or claims equality."""
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

    def tests(self) -> list[tuple[float, bool]]:
        """Probability by chance, and whether the data are on the claim's side: of the direction, then of the size."""
        d = self.difference
        if d is None:
            return [(1.0, False), (1.0, False)]
        if self.equal:
            margin = EQUAL_WITHIN * abs(d.level)
            return [(d.probability(abs(d.mean), margin), abs(d.mean) < margin), (1.0, False)]
        gain = d.mean if self.higher else -d.mean
        if self.share is None:
            return [(d.probability(gain, 0.0), gain > 0.0), (1.0, False)]
        half = 0.5 * self.share * abs(d.level)
        return [(d.probability(gain, 0.0), gain > 0.0), (d.probability(gain, half), gain > half)]


def answers(asked: Sequence[Question]) -> list[Answers]:
    """The answers to all questions, which are one family."""
    tests = [test for one in asked for test in one.tests()]
    counts = [k for k, one in enumerate(asked) if one.difference is not None]
    real = [2 * k for k in counts] + [2 * k + 1 for k in counts if _has_size(asked[k])]
    chance = [1.0] * len(tests)
    for k, p in zip(real, holm([tests[k][0] for k in real]), strict=True):
        chance[k] = p
    said = [UNTOLD if p > LEVEL else HOLDS if own else FAILS for p, (_, own) in zip(chance, tests, strict=True)]
    return [Answers(said[2 * k], said[2 * k + 1] if _has_size(one) else NONE, (chance[2 * k], chance[2 * k + 1]))
            for k, one in enumerate(asked)]


def holm(chance: Sequence[float]) -> list[float]:
    """Probabilities corrected by Holm's method, in the order given."""
    order, out, least = sorted(range(len(chance)), key=lambda k: chance[k]), [1.0] * len(chance), 0.0
    for rank, k in enumerate(order):
        least = max(least, min(1.0, (len(chance) - rank) * chance[k]))
        out[k] = least
    return out


def _has_size(one: Question) -> bool:
    return not one.equal and one.share is not None
