"""Whether a claim holds, from paired differences over objects, trainings and draws (`vsfsim.bench.board.compare`), and
Holm's correction over all claims.

*Direction*: a claim that one side errs less is a two-sided t test of the difference against 0, a claim that two sides
are equal one of its size against a margin (an equivalence test and its reverse, Schuirmann 1987): more data can prove
either answer. *Size*: our improvement over the worse side's value is tested against half of the paper's. All tests of
all claims are one family (Holm 1979).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vsfsim.bench.board.compare import LEVEL, Paired, holm

HOLDS, FAILS, UNTOLD = "holds", "does not hold", "cannot be told"

EQUAL_WITHIN = 0.15
"""Two sides are equal if they differ by less than this share of the second one."""


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

    difference: Paired | None
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
            return [(d.chance(margin if d.mean >= 0.0 else -margin), abs(d.mean) < margin)]
        sign = 1.0 if self.higher else -1.0
        least = [0.0] if self.share is None else [0.0, 0.5 * self.share * abs(d.level)]
        return [(d.chance(sign * one), sign * d.mean > one) for one in least]


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
