"""`vsfsim claims`: what the two papers claim, with their figures, against stored results.

A claim says that one method errs less than another, or that two cannot be told apart. It is decided object by object:
it holds if the paired difference has the claimed sign by more than two standard errors over objects, it does not hold
if it has the other sign by as much, and else it cannot be told. Two sides are equal if they are not told apart by two
standard errors that are small enough to tell a difference of `EQUAL_WITHIN`. Where a paper's figures differ by more
than that share, and ours by less even with two standard errors added, the claim does not hold either. A result is found
by its method, its preset and its task; where one is missing, the claim cannot be told and the command that makes the
result is printed.

The claims on tables that are no plain rows stand in the files of the studies (`vsfsim.papers.verdicts`), and so do
the experiments that say why a claim does not hold: each asks the same of other data.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vsfsim.bench.board.compare import FEWEST_OBJECTS, TOLD_APART, ByObject, Paired, by_object, interval, paired
from vsfsim.bench.leaderboard import Board, Row
from vsfsim.bench.metrics import METRICS
from vsfsim.core.text_table import text_table

HOLDS, FAILS, UNTOLD = "holds", "does not hold", "cannot be told"

DATA = "data"
"""What an experiment changes that asks a world in which the papers' model is exact: what fails there, too, is the
method's. Any other experiment that fails rules out what it changes, and no more."""

EQUAL_WITHIN = 0.15
"""Two sides count as equal only if a difference of this share of the second one would have been told; a wider interval
says nothing."""


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
    figures: str
    """The paper's, of both sides: two decimal numbers, the better side's first, or words where it prints none."""
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
    difference: Paired | None
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
                       + (", so the method" if self.changes == DATA else ""),
                UNTOLD: f"open: {self.changes}; {where} it cannot be told either ({d})"}[self.answer]


@dataclass(frozen=True)
class Verdict:
    """A claim beside our results."""

    claim: Claim
    """The claim."""
    answer: str
    """`HOLDS`, `FAILS` or `UNTOLD`."""
    ours: str
    """Both sides with their standard errors over objects, or why there is none."""
    difference: Paired | None
    """Better minus worse over objects; None where a result is missing."""
    commands: tuple[str, ...] = field(default=())
    """Which made the results, or would make the missing ones."""
    experiments: tuple[Experiment, ...] = field(default=())
    """On the same claim."""


def _pair(kind: str, task: str, table: str, zero_table: str, figures: Mapping[str, str]) -> list[Claim]:
    """The claims of SBML that are the same for plants and shoes."""
    def claim(key: str, text: str, source: str, better: tuple[str, str], worse: tuple[str, str], *,
              equal: bool = False) -> Claim:
        return Claim(text, source, figures[key], task, Side(*better), Side(*worse), equal=equal, key=f"{kind}/{key}")

    return [
        claim("average", "before any touch the learned prior errs less than the average Gaussian prior", table,
              ("sbml", "0"), ("gaussian", "0")),
        claim("zero", "before any touch the learned prior errs less than predicting zero", zero_table, ("sbml", "0"),
              ("gaussian-zero", "0")),
        claim("few", "after 5 touches the learned prior errs less than the average Gaussian prior", table,
              ("sbml", "5"), ("gaussian", "5")),
        claim("few zero", "after 10 touches the learned prior errs less than the zero Gaussian prior", zero_table,
              ("sbml", "10"), ("gaussian-zero", "10")),
        claim("falls", "the error of the learned prior falls from 0 to 10 touches", table, ("sbml", "10"),
              ("sbml", "0")),
        claim("all", "a stiffness field fitted to all touches errs less than predicting zero", table,
              ("point-vsf", "all"), ("gaussian-zero", "0")),
        claim("imaml", "before any touch the learned prior errs less than iMAML with vision", table, ("sbml", "0"),
              ("imaml-vision", "0")),
        claim("imaml few", "after 10 touches the learned prior errs less than iMAML with vision", table,
              ("sbml", "10"), ("imaml-vision", "10")),
        claim("vision", "before any touch iMAML with vision cannot be told from iMAML without", zero_table,
              ("imaml", "0"), ("imaml-vision", "0"), equal=True),
    ]


def claims_of(size: str = "mini") -> list[Claim]:
    """The claims, asked of the tasks of a size.

    Args:
        size: "mini", or "standard" for the tasks of the papers' size.
    """
    mini = "-mini" if size == "mini" else ""
    plants, shoes = (f"fewshot-{name}" for name in (f"plants-v4{mini}-v1", f"shoes-v2{mini}-v3"))
    out = _pair("plants", plants, "SBML, table 1", "SBML, tables 1 and 4", {
        "average": "2.80 and 5.23 N m", "zero": "2.80 and 3.55 N m", "few": "2.67 and 4.42 N m",
        "few zero": "2.61 and 2.88 N m", "falls": "2.61 and 2.80 N m", "all": "2.57 and 3.55 N m",
        "imaml": "2.80 and 3.86 N m", "imaml few": "2.61 and 4.51 N m", "vision": "3.95 and 3.86 N m"})
    out += [
        Claim("on plants, predicting zero errs less than the average Gaussian prior", "SBML, tables 1 and 4",
              "3.55 and 5.23 N m", plants, Side("gaussian-zero", "0"), Side("gaussian", "0"), key="plants/order"),
        Claim("the learned prior before any touch errs less than the zero Gaussian prior after 10",
              "SBML, appendix C.1", "2.80 and 2.88 N m", plants, Side("sbml", "0"), Side("gaussian-zero", "10"))]
    out += _pair("shoes", shoes, "SBML, table 2", "SBML, tables 2 and 5", {
        "average": "7.43 and 8.27 hPa", "zero": "7.43 and 9.21 hPa", "few": "5.05 and 5.54 hPa",
        "few zero": "4.18 and 4.63 hPa", "falls": "4.18 and 7.43 hPa", "all": "4.10 and 9.21 hPa",
        "imaml": "7.43 and 9.95 hPa", "imaml few": "4.18 and 6.15 hPa", "vision": "7.44 and 9.95 hPa"})
    out += [
        Claim("on shoes, the average Gaussian prior errs less than predicting zero", "SBML, tables 2 and 5",
              "8.27 and 9.21 hPa", shoes, Side("gaussian", "0"), Side("gaussian-zero", "0")),
        Claim("the neural field finds a stiff inclusion better than points", "Neural VSF, table I",
              "F1 0.493 and 0.329", "inclusion-mini-v3", Side("neural-vsf", "all"), Side("point-vsf", "all"),
              metric="mask_f1", note="one force a frame of a ball here; dense forces of a bubble there"),
        Claim("the neural field locates a hidden object at a smaller angle than contact points", "Neural VSF, fig. 7",
              "drawn, no number", "localization-mini-v3", Side("neural-vsf", "all"), Side("contact-points", "all"),
              metric="rotation_error", note="one force a frame of a ball here; dense forces of a bubble there",
              key="pads/angle")]
    return out


def judge(claims: Sequence[Claim], boards: Mapping[str, Board], *, preset: str = "tuned") -> list[Verdict]:
    """Every claim beside the results of its task.

    Args:
        claims: to be judged. boards: by name of the task. preset: of the methods; a result without a preset counts
        where the task has none with it.
    """
    return [_judge(claim, boards.get(claim.task), preset) for claim in claims]


def _judge(claim: Claim, board: Board | None, preset: str) -> Verdict:
    sides = [(side, _row(board, side.method, preset)) for side in (claim.better, claim.worse)]
    missing = [command_for(side.method, claim.task, preset) for side, row in sides if row is None]
    if missing:
        return Verdict(claim, UNTOLD, "no result", None, tuple(dict.fromkeys(missing)))
    known = board is not None and claim.metric == board.task.primary
    values = [(row.objects.get(side.shot) if known else None) or by_object(row.result, claim.metric, side.shot)
              for side, row in sides if row is not None]
    commands = tuple(dict.fromkeys(f"{command_for(row.result.method, claim.task, row.result.preset)} ({row.path.name})"
                                   for _, row in sides if row is not None))
    if not all(values):
        return Verdict(claim, UNTOLD, f"no {claim.metric} at these shots", None, commands)
    return Verdict(claim, *decide(claim, *values), commands)


def decide(claim: Claim, better: ByObject, worse: ByObject) -> tuple[str, str, Paired]:
    """The answer, both sides in words, and their paired difference.

    Args:
        claim: which metric, and whether it says that the sides are equal. better, worse: values by object.
    """
    found = paired(better, worse)
    sign = -1.0 if METRICS[claim.metric].higher_is_better else 1.0
    least, wide = EQUAL_WITHIN * abs(interval(worse)[0]), TOLD_APART * found.error
    if claim.equal:
        answer = FAILS if found.told_apart else HOLDS if wide <= least and found.objects >= FEWEST_OBJECTS else UNTOLD
    elif found.told_apart:
        answer = HOLDS if sign * found.mean < 0.0 else FAILS
    else:
        same = found.objects >= FEWEST_OBJECTS and abs(found.mean) + wide < least
        answer = FAILS if same and _paper_share(claim) > EQUAL_WITHIN else UNTOLD
    return answer, f"{_written(better)} and {_written(worse)}", found


def _paper_share(claim: Claim) -> float:
    """Difference of the paper's two figures over the larger one [-]; 0 where it has no numbers."""
    found = [float(word) for word in re.findall(r"\d+\.\d+", claim.figures)]
    return abs(found[0] - found[1]) / max(found) if len(found) == 2 else 0.0


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


def text(verdicts: Sequence[Verdict]) -> str:
    """The verdicts for a terminal, numbered, with the commands behind them."""
    rows = [[str(k), v.answer, v.claim.text, v.claim.source, v.claim.figures, v.ours, difference(v)]
            for k, v in enumerate(verdicts, start=1)]
    head = ["#", "verdict", "claim", "source", "paper", "here, ± standard error over objects", "difference (objects)"]
    lines = [text_table(head, rows), "",
             f"{counts(verdicts)} Told apart: paired difference over objects of more than "
             f"{TOLD_APART:g} standard errors. Values here are errors over that of predicting zero, if the paper's are "
             f"errors."]
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


def counts(verdicts: Sequence[Verdict]) -> str:
    """How many claims hold, in a sentence."""
    told = {word: sum(v.answer == word for v in verdicts) for word in (HOLDS, FAILS, UNTOLD)}
    return (f"Of {len(verdicts)} claims {told[HOLDS]} hold, {told[FAILS]} do not hold, and {told[UNTOLD]} cannot be "
            f"told.")


def conclusions(verdicts: Sequence[Verdict]) -> list[str]:
    """What experiments say of claims that do not hold or cannot be told, each with the claim's number."""
    return [f"{k}: {e.conclusion}" for k, v in enumerate(verdicts, start=1) for e in v.experiments
            if v.answer != HOLDS and v.difference is not None and e.difference is not None]


def difference(verdict: Verdict) -> str:
    """Better minus worse with its standard error, and the number of objects; "" where a result is missing."""
    d = verdict.difference
    return "" if d is None or not d.objects else f"{d.mean:+.3f} ± {d.error:.3f} ({d.objects})"


def table(verdicts: Sequence[Verdict]) -> list[dict[str, Any]]:
    """The verdicts for JSON."""
    return [{"claim": v.claim.text, "source": v.claim.source, "paper": v.claim.figures, "task": v.claim.task,
             "metric": v.claim.metric, "verdict": v.answer, "here": v.ours, "note": v.claim.note,
             "difference": None if v.difference is None else {"mean": v.difference.mean, "error": v.difference.error,
                                                              "objects": v.difference.objects},
             "commands": list(v.commands),
             "experiments": [{"changes": e.changes, "study": e.study, "verdict": e.answer, "conclusion": e.conclusion}
                             for e in v.experiments]} for v in verdicts]
