"""`vsfsim papers claims`: what the two papers claim, with their figures, against stored results.

Claims stand in the files of the studies: one says that one variant errs less than another, or that two are equal.
`papers.decide` answers it twice: whether the *direction* is the claimed one, and whether the *size* is at least half of
the paper's. Where a result is missing, the claim cannot be told and the command that makes it is printed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from papers.decide import EQUAL_WITHIN, FAILS, HOLDS, LEVEL, UNTOLD, Answers, Question, answers
from papers.figures import figure, said
from papers.results import MADE, Found, stored
from papers.study import Asked, Study, load_study, studies
from vsfsim.bench.board.compare import Paired, Runs, paired
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
    """Both sides with their standard errors over objects and runs, or why there is none."""
    difference: Paired | None
    """Better minus worse over objects; None where a result is missing."""
    rows: Mapping[str, str]
    """The rows that it stands on, or those that are missing: the command that makes each, by its file."""
    alone: bool = False
    """A side has one training, so that the error says nothing of others."""
    answers: Answers = NOT_ASKED
    """Among all claims (`all_verdicts`)."""

    @property
    def question(self) -> Question:
        """As it is tested."""
        one = self.claim
        higher = METRICS[one.metric].higher_is_better or one.metric == "rotation_error"  # a share of objects
        if not one.figures:
            return Question(self.difference, one.equal, higher, None)
        better, worse = (figure(name)[0] for name in one.figures)
        return Question(self.difference, one.equal, higher, (better - worse if higher else worse - better) / worse)


def all_verdicts(asked: Iterable[Study] = (), *, boards: dict[str, Board] | None = None, made: bool = True
                 ) -> list[Verdict]:
    """The claims of some studies beside their stored results; all together are one family.

    Args:
        asked: the studies; default: all that ship. boards, made: as of `papers.results.stored`.

    Raises:
        TaskError: a result is damaged.
    """
    boards = {} if boards is None else boards
    found = [_verdict(study, claim, rows) for study in asked or map(load_study, studies()) if study.claims
             for rows in [stored(study, boards, made)] for claim in study.claims]
    return [dataclasses.replace(v, answers=a) for v, a in zip(found, answers([v.question for v in found]), strict=True)]


def _verdict(study: Study, asked: Asked, found: Mapping[str, Found]) -> Verdict:
    sides, known = (asked.better, asked.worse), {variant.name: variant for variant in study.variants}
    missing = [known[name] for name, _ in sides if name not in found]
    here = {name for name, one in found.items() if MADE in one.path.parents}
    rows = {str((MADE if one.name in here else Path("leaderboard")) / study.place(one)): study.command(one)
            for one in missing or [known[name] for name, _ in sides]}
    if missing:
        return Verdict(asked, study.task, "no result", None, rows)
    values = [values_of(found[name], asked.metric, shot) for name, shot in sides]
    if not all(values):
        return Verdict(asked, study.task, f"no {asked.metric} at these shots", None, rows)
    alone = any("seed" in found[name].result.parameters and len(next(iter(of.values()))) == 1
                for (name, _), of in zip(sides, values, strict=True))
    return Verdict(asked, study.task, " and ".join(map(interval_text, values)), paired(*values), rows, alone)


def values_of(found: Found, metric: str, shot: str) -> Runs:
    """One side of a claim; an angle becomes 1 within `ANGLE` and 0 beyond, of the mean over runs.

    Args:
        found: result of a variant. metric: of the claim. shot: label.
    """
    values = found.values(metric, shot)
    return {name: np.array([[of.mean() <= ANGLE]], float) for name, of in values.items()} if (
        metric == "rotation_error") else values


HEAD = ("#", "direction", "size", "claim", "paper", "here, ± standard error over objects and runs",
        "difference ± 95 % (objects)", "improvement here and there")
"""Of the table of all claims."""

RULE = (f"Direction: t test of the difference over objects, trainings and draws, or for equality of its size against "
        f"{EQUAL_WITHIN:.0%} of the second side. Size: whether the improvement is at least half of the paper's. All "
        f"together are wrong with a probability of {LEVEL:.0%} at most (Holm). An angle counts as the share of objects "
        f"within {ANGLE:g} degrees. Values are errors over that of predicting zero, if the paper's are errors.")


def cells(number: int, v: Verdict) -> list[str]:
    """A row of the table under `HEAD`: last, better minus worse with half of its 95 % interval, the number of objects
    and whether one training stands for all; and the improvement of the worse side's value, here with its interval and
    in the paper. Both are "" where a result is missing, the second where there are no figures."""
    d, asked, difference, improvement = v.difference, v.question, "", ""
    if d is not None and d.objects:
        difference = f"{d.mean:+.3f} ± {d.half_width:.3f} ({d.objects}{', one training' if v.alone else ''})"
    if d is not None and asked.has_size and d.level:
        gain, half = (d.mean if asked.higher else -d.mean) / abs(d.level), d.half_width / abs(d.level)
        improvement = f"{gain:.0%} ({gain - half:.0%} to {gain + half:.0%}) and {asked.share:.0%}"
    return [str(number), v.answers.direction, v.answers.size or "-", f"{v.claim.text} ({v.claim.source})",
            said(v.claim.figures, v.claim.words), v.ours, difference, improvement]


def text(verdicts: Sequence[Verdict]) -> str:
    """The verdicts for a terminal, numbered, with the rows behind them and the command that makes each."""
    numbered = list(enumerate(verdicts, start=1))
    lines = [text_table(list(HEAD), [cells(k, v) for k, v in numbered]), "", counts(verdicts), RULE]
    lines += [f"{k}: {v.claim.note}" for k, v in numbered if v.claim.note]
    for words, there in (("Rows behind the answers, and what makes them:", True), ("Rows that are missing:", False)):
        asked = [(k, v) for k, v in numbered if (v.difference is not None) == there]
        numbers = {row: ", ".join(str(k) for k, v in asked if row in v.rows.items())
                   for _, v in asked for row in v.rows.items()}
        lines += ["", words] * bool(numbers)
        lines += [f"  {file}: {command}  # claims {claims}" for (file, command), claims in numbers.items()]
    return "\n".join(lines)


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
