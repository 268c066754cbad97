"""`vsfsim papers claims`: what the two papers claim, with their figures, against stored results.

A claim says that one method errs less than another, or that two are equal. `papers.decide` answers it twice:
whether the *direction* is the claimed one, and whether the *size* is at least half of the paper's. A result is found by
its method, its preset and its task; where one is missing, the claim cannot be told and the command that makes the
result is printed. Figures are cells of `papers.figures`.

The claims on tables that are no plain rows stand in the files of the studies (`papers.verdicts`), and so do
the experiments that say why a claim does not hold: each asks the same of other data.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from papers.decide import (
    EQUAL_WITHIN,
    FAILS,
    HOLDS,
    LEVEL,
    UNTOLD,
    Answers,
    Difference,
    Question,
    Values,
    answers,
)
from papers.figures import figure, said
from vsfsim.bench.board.compare import ByObject, by_object, interval
from vsfsim.bench.leaderboard import Board, Row
from vsfsim.bench.metrics import METRICS
from vsfsim.bench.result import Result
from vsfsim.bench.task import Protocol, load_task
from vsfsim.core.text_table import text_table

SIZES = {"standard": ("fewshot-plants-v4-v1", "fewshot-shoes-v3-v1"),
         "superseded": ("fewshot-plants-v4-v1", "fewshot-shoes-v2-v3"),
         "mini": ("fewshot-plants-v4-mini-v1", "fewshot-shoes-v3-mini-v1")}
"""The tasks of plants and of shoes by size, in the order in which a claim takes the first that has results. Those of
the second are superseded; they count until the rows of the first are there."""

DATA = "data"
"""What an experiment changes that asks a world in which the papers' model is exact: what fails there, too, is the
method's. Any other experiment that fails rules out what it changes, and no more."""

TRAININGS = 3
"""Of a method, at least, before its failure on data that fit its model counts as its own."""

ANGLE = 15.0
"""An object whose pose is found within this angle counts as found [degrees]."""

NOT_ASKED = Answers(UNTOLD, "", (1.0, 1.0))
"""Before all claims are answered together."""


@dataclass(frozen=True)
class Side:
    """A method at a number of touches."""

    method: str
    """Name of the method."""
    shot: str
    """Label of the shot."""


@dataclass(frozen=True)
class Claim:
    """One claim of a paper."""

    text: str
    """In our words."""
    source: str
    """Paper and place."""
    figures: tuple[str, ...]
    """Cells of `papers.figures` of both sides, the better first; () where the paper prints none."""
    task: str
    """Name of the task that asks it here."""
    better: Side
    """What the paper finds better."""
    worse: Side
    """Than what."""
    metric: str = "rmse_ratio"
    """By which metric."""
    equal: bool = False
    """The paper finds no difference."""
    note: str = ""
    """What is different here, or ""."""
    key: str = ""
    """By which experiments name it, "" where there are none."""
    words: str = "drawn, no number"
    """In the place of figures."""

    def question(self, difference: Difference | None) -> Question:
        """As it is tested."""
        higher = METRICS[self.metric].higher_is_better or self.metric == "rotation_error"  # a share of objects
        if not self.figures:
            return Question(difference, self.equal, higher, None)
        better, worse = (figure(name).value for name in self.figures)
        return Question(difference, self.equal, higher, (better - worse if higher else worse - better) / worse)


@dataclass(frozen=True)
class Experiment:
    """The same as a claim asks, asked of other data."""

    key: str
    """Of the claim."""
    changes: str
    """What it changes; `DATA` where it asks data that fit the method's model."""
    study: str
    """Name of the study that it is part of."""
    answer: str
    """`HOLDS`, `FAILS` or `UNTOLD`."""
    difference: Difference | None
    """Better minus worse over objects; None where a result is missing."""

    @property
    def conclusion(self) -> str:
        """What it says of a claim that does not hold."""
        where = f"in study {self.study}"
        if self.difference is None:
            return f"{where} nothing is stored"
        d = f"{self.difference.mean:+.3f} ± {self.difference.error:.3f}, {self.difference.objects} objects"
        return {HOLDS: f"at fault: {self.changes}; {where} it holds ({d})",
                FAILS: f"not at fault: {self.changes}; {where} it does not hold either ({d})"
                       + (", so the method" if self.changes == DATA and self.difference.trainings >= TRAININGS else ""),
                UNTOLD: f"open: {self.changes}; {where} it cannot be told either ({d})"}[self.answer]


@dataclass(frozen=True)
class Verdict:
    """A claim beside our results."""

    claim: Claim
    """The claim."""
    ours: str
    """Both sides with their standard errors over objects, or why there is none."""
    difference: Difference | None
    """Better minus worse over objects; None where a result is missing."""
    commands: tuple[str, ...] = field(default=())
    """Which made the results, or would make the missing ones."""
    experiments: tuple[Experiment, ...] = field(default=())
    """On the same claim."""
    answers: Answers = NOT_ASKED
    """Among all claims (`decided`)."""

    @property
    def question(self) -> Question:
        """As it is tested."""
        return self.claim.question(self.difference)


def _sbml(kind: str, task: str, main: str, other: str) -> list[Claim]:
    """The claims of SBML on plants or shoes, by its tables of the main rows and of the others."""
    columns = {"sbml": f"{main}/broad", "gaussian": f"{main}/average", "imaml-vision": f"{main}/imaml-vision",
               "point-vsf": f"{main}/", "gaussian-zero": f"{other}/zero", "imaml": f"{other}/imaml"}

    def claim(key: str, text: str, better: str, worse: str, *, source: str = "", equal: bool = False) -> Claim:
        first, second = (Side(*side.split("/")) for side in (better, worse))
        figures = tuple(f"{columns[side.method]}/{side.shot}" for side in (first, second))
        return Claim(text, source or source_of(figures), figures, task, first, second, equal=equal,
                     key=f"{kind}/{key}")

    own = [claim("order", "on shoes, the average Gaussian prior errs less than predicting zero", "gaussian/0",
                 "gaussian-zero/0")] if kind == "shoes" else [
           claim("order", "on plants, predicting zero errs less than the average Gaussian prior", "gaussian-zero/0",
                 "gaussian/0"),
           claim("prior", "the learned prior before any touch errs less than the zero Gaussian prior after 10",
                 "sbml/0", "gaussian-zero/10", source="SBML, appendix C.1")]
    return [
        claim("average", "before any touch the learned prior errs less than the average Gaussian prior", "sbml/0",
              "gaussian/0"),
        claim("zero", "before any touch the learned prior errs less than predicting zero", "sbml/0", "gaussian-zero/0"),
        claim("few", "after 5 touches the learned prior errs less than the average Gaussian prior", "sbml/5",
              "gaussian/5"),
        claim("few zero", "after 10 touches the learned prior errs less than the zero Gaussian prior", "sbml/10",
              "gaussian-zero/10"),
        claim("falls", "the error of the learned prior falls from 0 to 10 touches", "sbml/10", "sbml/0"),
        claim("all", "a stiffness field fitted to all touches errs less than predicting zero", "point-vsf/all",
              "gaussian-zero/0"),
        claim("imaml", "before any touch the learned prior errs less than iMAML with vision", "sbml/0",
              "imaml-vision/0"),
        claim("imaml few", "after 10 touches the learned prior errs less than iMAML with vision", "sbml/10",
              "imaml-vision/10"),
        claim("vision", "before any touch iMAML with vision cannot be told from iMAML without", "imaml/0",
              "imaml-vision/0", equal=True),
        *own]


def claims_of(size: str = "mini") -> list[Claim]:
    """The claims, asked of the tasks of a size.

    Args:
        size: one of `SIZES`.
    """
    plants, shoes = SIZES[size]
    return [
        *_sbml("plants", plants, "SBML 1", "SBML 4"),
        *_sbml("shoes", shoes, "SBML 2", "SBML 5"),
        Claim("the neural field finds a stiff inclusion better than points", "Neural VSF, table I",
              ("Neural VSF I/F1/neural", "Neural VSF I/F1/points, 20k"), "inclusion-mini-v3",
              Side("neural-vsf", "all"), Side("point-vsf", "all"), metric="mask_f1",
              note="one force a frame of a ball here; dense forces of a bubble there"),
        Claim(f"the neural field turns a hidden object to within {ANGLE:g} degrees more often than contact points",
              "Neural VSF, fig. 7", (), "localization-mini-v3", Side("neural-vsf", "all"),
              Side("contact-points", "all"), metric="rotation_error",
              note="one force a frame of a ball here; dense forces of a bubble there", key="pads/angle")]


def source_of(figures: Sequence[str]) -> str:
    """Paper and tables of some figures, in words."""
    tables = list(dict.fromkeys(name.split("/")[0].rpartition(" ") for name in figures))
    return f"{tables[0][0]}, table{'s' if len(tables) > 1 else ''} {' and '.join(number for _, _, number in tables)}"


def judge(claims: Sequence[Claim], boards: Mapping[str, Board], *, preset: str = "tuned") -> list[Verdict]:
    """Every claim beside the results of its task, not answered yet (`decided`).

    Args:
        claims: to be judged. boards: by name of the task. preset: of the methods; a result without a preset counts
        where the task has none with it.
    """
    return [_judge(claim, boards.get(claim.task), preset) for claim in claims]


def _judge(claim: Claim, board: Board | None, preset: str) -> Verdict:
    sides = [(side, _row(board, side.method, preset)) for side in (claim.better, claim.worse)]
    missing = [command_for(side.method, claim.task, preset) for side, row in sides if row is None]
    if missing or board is None:
        return Verdict(claim, "no result", None, tuple(dict.fromkeys(missing)))
    known = claim.metric == board.task.primary
    values = [values_of(row.result, board.task.protocol, claim.metric, side.shot,
                        (row.objects.get(side.shot) if known else None)
                        or by_object(row.result, claim.metric, side.shot)) for side, row in sides if row is not None]
    commands = tuple(dict.fromkeys(f"{command_for(row.result.method, claim.task, row.result.preset)} ({row.path.name})"
                                   for _, row in sides if row is not None))
    return beside(claim, values, commands)


def values_of(result: Result, protocol: Protocol, metric: str, shot: str, objects: ByObject) -> Values:
    """One side of a claim; an angle becomes 1 within `ANGLE` and 0 beyond.

    Args:
        result: of the side. protocol: of its runs. metric: of the claim. shot: label. objects: values by object.
    """
    if metric == "rotation_error":
        return Values({name: float(value <= ANGLE) for name, value in objects.items()})
    score = result.scores.get(metric, {}).get(shot)
    trainings = len({protocol.training_of(run) for run in result.seeds}) if "seed" in result.parameters else 0
    return Values(objects, score.std if score is not None else 0.0, len(result.seeds), trainings)


def beside(claim: Claim, values: Sequence[Values], commands: tuple[str, ...]) -> Verdict:
    """A claim with the values of both sides."""
    if not all(one.objects for one in values):
        return Verdict(claim, f"no {claim.metric} at these shots", None, commands)
    return Verdict(claim, " and ".join(_written(one.objects) for one in values), Difference.of(*values), commands)


def decided(found: Sequence[Verdict]) -> list[Verdict]:
    """Verdicts with their answers: all together are one family."""
    return [dataclasses.replace(v, answers=a) for v, a in zip(found, answers([v.question for v in found]), strict=True)]


def with_results(sizes: Sequence[Sequence[Verdict]]) -> list[Verdict]:
    """Of each claim the verdict at the first size at which results are stored, else at the last one.

    Args:
        sizes: verdicts on the same claims, asked of tasks of several sizes.
    """
    known = [{(v.claim.text, v.claim.source): v for v in verdicts} for verdicts in sizes]
    return [next((of[key] for of in known if key in of and of[key].difference is not None), last)
            for key, last in known[-1].items()]


def _row(board: Board | None, method: str, preset: str) -> Row | None:
    """The ranked row of a method with a preset, else without one."""
    rows = [row for row in board.rows if row.rank and row.result.method == method] if board is not None else []
    return next((row for wanted in (preset, "") for row in rows if row.result.preset == wanted), None)


def _written(values: ByObject) -> str:
    mean, error = interval(values)
    return f"{mean:.3f}" + (f" ± {error:.3f}" if error == error else "")


def command_for(method: str, task: str, preset: str) -> str:
    """The command that makes a result."""
    return f"vsfsim evaluate --method {method}{f' --preset {preset}' if preset else ''} --task {task}"


HEAD = ("#", "direction", "size", "claim", "paper", "here, ± standard error over objects",
        "difference ± 95 % (objects)", "improvement here and there")
"""Of the table of all claims."""


def cells(number: int, v: Verdict) -> list[str]:
    """A row of the table under `HEAD`."""
    return [str(number), v.answers.direction, v.answers.size or "-", f"{v.claim.text} ({v.claim.source})",
            said(v.claim.figures, v.claim.words), v.ours, difference(v), improvement(v)]


def text(verdicts: Sequence[Verdict]) -> str:
    """The verdicts for a terminal, numbered, with the commands behind them."""
    rows = [cells(k, v) for k, v in enumerate(verdicts, start=1)]
    lines = [text_table(list(HEAD), rows), "", counts(verdicts), RULE, *superseded(verdicts)]
    lines += [f"{k}: {v.claim.note}" for k, v in enumerate(verdicts, start=1) if v.claim.note]
    why = conclusions(verdicts)
    if why:
        lines += ["", "Of claims that do not hold or cannot be told, by experiments:", *(f"  {line}" for line in why)]
    for words, wanted in (("Made by:", True), ("Missing; these commands make them:", False)):
        by_command: dict[str, list[int]] = {}
        for k, v in enumerate(verdicts, start=1):
            for command in v.commands if (v.difference is not None) == wanted else ():
                by_command.setdefault(command, []).append(k)
        if by_command:
            lines += ["", words, *(f"  {command}  # claims {', '.join(map(str, numbers))}"
                                   for command, numbers in by_command.items())]
    return "\n".join(lines)


RULE = (f"Direction: t test of the difference over objects, or for equality of its size against {EQUAL_WITHIN:.0%} of "
        f"the second side. Size: whether the improvement is at least half of the paper's. All together are wrong with "
        f"a probability of {LEVEL:.0%} at most (Holm). An angle counts as the share of objects within {ANGLE:g} "
        f"degrees. Values are errors over that of predicting zero, if the paper's are errors.")


def counts(verdicts: Sequence[Verdict]) -> str:
    """How many claims hold, in two sentences."""
    def of(words: Sequence[str]) -> str:
        told = [sum(word == one for word in words) for one in (HOLDS, FAILS, UNTOLD)]
        return f"{told[0]} hold, {told[1]} do not hold, and {told[2]} cannot be told."

    sized = [v.answers.size for v in verdicts if v.answers.size]
    return (f"Of {len(verdicts)} claims {of([v.answers.direction for v in verdicts])} "
            f"Of the sizes of {len(sized)} with figures {of(sized)}")


def superseded(verdicts: Sequence[Verdict]) -> list[str]:
    """A sentence for every task that was measured and is superseded, with the numbers of its claims."""
    by_task: dict[str, list[int]] = {}
    for k, v in enumerate(verdicts, start=1):
        if v.difference is not None:
            by_task.setdefault(v.claim.task, []).append(k)
    later = {task: load_task(task).superseded_by for task in by_task}
    return [f"Claims {', '.join(map(str, by_task[task]))} were measured on {task}, which {new} supersedes."
            for task, new in later.items() if new]


def conclusions(verdicts: Sequence[Verdict]) -> list[str]:
    """What experiments say of claims that do not hold or cannot be told, each with the claim's number."""
    return [f"{k}: {e.conclusion}" for k, v in enumerate(verdicts, start=1) for e in v.experiments
            if v.answers.direction != HOLDS and v.difference is not None and e.difference is not None]


def difference(verdict: Verdict) -> str:
    """Better minus worse with half of its 95 % interval, the number of objects, and whether one training stands for
    all; "" where a result is missing."""
    d = verdict.difference
    if d is None or not d.objects:
        return ""
    return f"{d.mean:+.3f} ± {d.half_width():.3f} ({d.objects}{', one training' if d.trainings == 1 else ''})"


def improvement(verdict: Verdict) -> str:
    """Of the worse side's value, here with its 95 % interval and in the paper; "" where there are no figures."""
    d, asked = verdict.difference, verdict.question
    if d is None or asked.equal or asked.share is None or not d.level:
        return ""
    gain, half = (d.mean if asked.higher else -d.mean) / abs(d.level), d.half_width() / abs(d.level)
    return f"{gain:.0%} ({gain - half:.0%} to {gain + half:.0%}) and {asked.share:.0%}"


def table(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """The verdicts for JSON."""
    return [{**dataclasses.asdict(v), "paper": said(v.claim.figures, v.claim.words),
             "conclusions": [e.conclusion for e in v.experiments]} for v in verdicts]
