"""The claims of the papers that studies decide, and the experiments on claims that do not hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from papers import claims
from papers.claims import SIZES, Claim, Experiment, Side, Verdict, beside, claims_of, decided, judge, values_of
from papers.decide import answers
from papers.results import Found, board_of, stored
from papers.study import Asked, Study, load_study, studies
from vsfsim.bench.leaderboard import Board


def all_verdicts(size: str = "", *, preset: str = "tuned", boards: dict[str, Board] | None = None,
                 made: bool = True) -> list[Verdict]:
    """All claims, those on plain rows first, with the experiments on them.

    Args:
        size: of the tasks; "" for the larger one, claim by claim, that has results. preset: of the methods in plain
        rows. boards: as of `stored`. made: results made here count; else only those that ship.

    Raises:
        TaskError: a result is damaged.
    """
    boards = {} if boards is None else boards
    found = []
    for one in (size,) if size else SIZES:
        wanted = claims_of(one)
        for name in dict.fromkeys(claim.task for claim in wanted):
            board_of(name, boards, made)
        asked, experiments = verdicts(one, boards=boards, made=made)
        found.append(with_experiments([*judge(wanted, boards, preset=preset), *asked], experiments))
    return decided(claims.with_results(found))


def verdicts(size: str = "mini", names: Sequence[str] | None = None, boards: dict[str, Board] | None = None,
             made: bool = True) -> tuple[list[Verdict], list[Experiment]]:
    """The claims of the studies beside their stored results, and their experiments.

    An experiment changes what a claim is asked of, so that one on tasks of another size counts as well where there is
    none of this size.

    Args:
        size: of the tasks. names: of studies, None for all that ship. boards, made: as of `stored`.
    """
    out, experiments = [], []
    for name in names if names is not None else studies():
        study = load_study(name)
        if not (study.claims or study.experiments):
            continue
        used = {side[0] for a in (*study.claims, *study.experiments) for side in (a.better, a.worse)}
        wanted = [v for v in study.variants if v.name in used]
        sizes = sorted(study.tasks or [size], key=lambda one: one != size)  # the one that is asked first
        found = {one: {name: f for name, f in stored(study, one, wanted, boards, made).items() if f.stands}
                 for one in (sizes if study.experiments else sizes[:1])}
        if study.claims and size in study.tasks:
            out += [_verdict(study, size, asked, found[size]) for asked in study.claims]
        for asked in study.experiments:
            asks = [_verdict(study, one, asked, found[one]) for one in sizes]
            experiments.append((study, asked, next((v for v in asks if v.difference is not None), asks[0])))
    told = answers([v.question for _, _, v in experiments])
    return out, [Experiment(asked.text, asked.note, study.name, one.direction, v.difference)
                 for (study, asked, v), one in zip(experiments, told, strict=True)]


def with_experiments(found: Sequence[Verdict], experiments: Sequence[Experiment]) -> list[Verdict]:
    """Verdicts with the experiments on their claims."""
    return [dataclasses.replace(v, experiments=tuple(e for e in experiments if v.claim.key and e.key == v.claim.key))
            for v in found]


def _verdict(study: Study, size: str, asked: Asked, found: Mapping[str, Found]) -> Verdict:
    claim = Claim(asked.text, asked.source, asked.figures, study.tasks.get(size, study.name), Side(*asked.better),
                  Side(*asked.worse), asked.metric, asked.equal, asked.note, f"{study.name}/{asked.text}", asked.words)
    sides = (asked.better, asked.worse)
    command = f"vsfsim papers study {study.name} --size {size}"
    if any(name not in found for name, _ in sides):
        return Verdict(claim, "no result", None, (command,))
    values = [values_of(found[name].result, study.task_of(found[name].variant, size).protocol, asked.metric, shot,
                        found[name].values(asked.metric, shot)) for name, shot in sides]
    files = ", ".join(dict.fromkeys(found[name].path.name for name, _ in sides))
    return beside(claim, values, (f"{command} ({files})",))
