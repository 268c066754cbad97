"""`vsfsim papers claims`: what the two papers claim, with their figures, against stored results.

Claims stand in the files of the studies: one says that one variant errs less than another, or that two are equal.
`papers.decide` answers it twice: whether the *direction* is the claimed one, and whether the *size* is at least half of
the paper's. Where a result is missing, the claim cannot be told and the command that makes it is printed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from papers.decide import EQUAL_WITHIN, FAILS, HOLDS, LEVEL, UNTOLD, Answers, Difference, Question, Values, answers
from papers.figures import figure, said
from papers.results import Found, stored
from papers.study import Asked, Study, load_study, studies
from vsfsim.bench.leaderboard import Board, interval_text
from vsfsim.bench.metrics import METRICS
from vsfsim.core.text_table import text_table

ANGLE = 15.0
"""An object whose pose is found within this angle counts as found [degrees]."""

NOT_ASKED = Answers(UNTOLD, "", (1.0, 1.0))
"""Before all claims are answered together."""


@dataclass(frozen=True)
class Verdict:
    """A claim beside our results."""

    claim: Asked
    """The claim."""
    task: str
    """Name of the task that asks it here."""
    ours: str
    """Both sides with their standard errors over objects, or why there is none."""
    difference: Difference | None
    """Better minus worse over objects; None where a result is missing."""
    command: str
    """Which made the results, with their files, or would make the missing ones."""
    answers: Answers = NOT_ASKED
    """Among all claims (`all_verdicts`)."""

    @property
    def question(self) -> Question:
        """As it is tested."""
        one = self.claim
        higher = METRICS[one.metric].higher_is_better or one.metric == "rotation_error"  # a share of objects
        if not one.figures:
            return Question(self.difference, one.equal, higher, None)
        better, worse = (figure(name).value for name in one.figures)
        return Question(self.difference, one.equal, higher, (better - worse if higher else worse - better) / worse)


def all_verdicts(asked: Sequence[Study] | None = None, *, boards: dict[str, Board] | None = None, made: bool = True
                 ) -> list[Verdict]:
    """The claims of some studies beside their stored results; all together are one family.

    Args:
        asked: the studies, None for all that ship. boards, made: as of `papers.results.stored`.

    Raises:
        TaskError: a result is damaged.
    """
    boards = {} if boards is None else boards
    known = [load_study(name) for name in studies()] if asked is None else asked
    found = [_verdict(study, claim, rows) for study in known if study.claims
             for rows in [stored(study, boards, made)] for claim in study.claims]
    return [dataclasses.replace(v, answers=a) for v, a in zip(found, answers([v.question for v in found]), strict=True)]


def _verdict(study: Study, asked: Asked, found: Mapping[str, Found]) -> Verdict:
    sides, command = (asked.better, asked.worse), f"vsfsim papers study {study.name}"
    if any(name not in found for name, _ in sides):
        return Verdict(asked, study.task, "no result", None, command)
    command += f" ({', '.join(dict.fromkeys(found[name].path.name for name, _ in sides))})"
    values = [values_of(found[name], asked.metric, shot) for name, shot in sides]
    if not all(one.objects for one in values):
        return Verdict(asked, study.task, f"no {asked.metric} at these shots", None, command)
    ours = " and ".join(interval_text(one.objects) for one in values)
    return Verdict(asked, study.task, ours, Difference.of(*values), command)


def values_of(found: Found, metric: str, shot: str) -> Values:
    """One side of a claim; an angle becomes 1 within `ANGLE` and 0 beyond.

    Args:
        found: result of a variant. metric: of the claim. shot: label.
    """
    objects, result = found.values(metric, shot), found.result
    if metric == "rotation_error":
        return Values({name: float(value <= ANGLE) for name, value in objects.items()})
    score = result.scores.get(metric, {}).get(shot)
    trainings = len(set(map(found.protocol.training_of, result.seeds))) if "seed" in result.parameters else 0
    return Values(objects, score.std if score is not None else 0.0, len(result.seeds), trainings)


HEAD = ("#", "direction", "size", "claim", "paper", "here, ± standard error over objects",
        "difference ± 95 % (objects)", "improvement here and there")
"""Of the table of all claims."""

RULE = (f"Direction: t test of the difference over objects, or for equality of its size against {EQUAL_WITHIN:.0%} of "
        f"the second side. Size: whether the improvement is at least half of the paper's. All together are wrong with "
        f"a probability of {LEVEL:.0%} at most (Holm). An angle counts as the share of objects within {ANGLE:g} "
        f"degrees. Values are errors over that of predicting zero, if the paper's are errors.")


def cells(number: int, v: Verdict) -> list[str]:
    """A row of the table under `HEAD`: last, better minus worse with half of its 95 % interval, the number of objects
    and whether one training stands for all; and the improvement of the worse side's value, here with its interval and
    in the paper. Both are "" where a result is missing, the second where there are no figures."""
    d, asked, difference, improvement = v.difference, v.question, "", ""
    if d is not None and d.objects:
        difference = (f"{d.mean:+.3f} ± {d.half_width():.3f} "
                      f"({d.objects}{', one training' if d.trainings == 1 else ''})")
    if d is not None and asked.has_size and d.level:
        gain, half = (d.mean if asked.higher else -d.mean) / abs(d.level), d.half_width() / abs(d.level)
        improvement = f"{gain:.0%} ({gain - half:.0%} to {gain + half:.0%}) and {asked.share:.0%}"
    return [str(number), v.answers.direction, v.answers.size or "-", f"{v.claim.text} ({v.claim.source})",
            said(v.claim.figures, v.claim.words), v.ours, difference, improvement]


def text(verdicts: Sequence[Verdict]) -> str:
    """The verdicts for a terminal, numbered, with the commands behind them."""
    rows = [cells(k, v) for k, v in enumerate(verdicts, start=1)]
    lines = [text_table(list(HEAD), rows), "", counts(verdicts), RULE]
    lines += [f"{k}: {v.claim.note}" for k, v in enumerate(verdicts, start=1) if v.claim.note]
    for words, there in (("Made by:", True), ("Missing; these commands make them:", False)):
        by_command = _numbers({k: v.command for k, v in enumerate(verdicts, start=1)
                               if (v.difference is not None) == there})
        if by_command:
            lines += ["", words, *(f"  {command}  # claims {numbers}" for command, numbers in by_command.items())]
    return "\n".join(lines)


def _numbers(named: Mapping[int, str]) -> dict[str, str]:
    """The numbers of claims by what they share, in words."""
    return {name: ", ".join(str(k) for k, one in named.items() if one == name) for name in named.values()}


def counts(verdicts: Sequence[Verdict]) -> str:
    """How many claims hold, in two sentences."""
    def of(words: Sequence[str]) -> str:
        told = [sum(word == one for word in words) for one in (HOLDS, FAILS, UNTOLD)]
        return f"{told[0]} hold, {told[1]} do not hold, and {told[2]} cannot be told."

    sized = [v.answers.size for v in verdicts if v.answers.size]
    return (f"Of {len(verdicts)} claims {of([v.answers.direction for v in verdicts])} "
            f"Of the sizes of {len(sized)} with figures {of(sized)}")


def table(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """The verdicts for JSON."""
    return [{**asdict(v), "paper": said(v.claim.figures, v.claim.words)} for v in verdicts]
