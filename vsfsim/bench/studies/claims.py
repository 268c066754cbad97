"""The claims of the papers that studies decide, and the experiments on claims that do not hold."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from vsfsim.bench.board.claims import UNTOLD, Claim, Experiment, Side, Verdict, decide
from vsfsim.bench.leaderboard import Board
from vsfsim.bench.studies.results import Found, stored
from vsfsim.bench.studies.study import Asked, Study, load_study, studies


def verdicts(size: str = "mini", names: Sequence[str] | None = None,
             boards: dict[str, Board] | None = None) -> tuple[list[Verdict], list[Experiment]]:
    """The claims of the studies beside their stored results, and their experiments.

    An experiment changes what a claim is asked of, so that one on tasks of another size counts as well.

    Args:
        size: of the tasks. names: of studies, None for all that ship. boards: as of `stored`.
    """
    out, experiments = [], []
    for name in names if names is not None else studies():
        study = load_study(name)
        if study.command or not (study.claims or study.experiments):
            continue
        used = {side[0] for a in (*study.claims, *study.experiments) for side in (a.better, a.worse)}
        at = size if size in study.tasks else next(iter(study.tasks), size)
        found = stored(study, at, [v for v in study.variants if v.name in used], boards)
        if study.claims and size in study.tasks:
            out += [_verdict(study, size, asked, found) for asked in study.claims]
        for asked in study.experiments:
            v = _verdict(study, size, asked, found)
            experiments.append(Experiment(asked.text, asked.note, study.name, v.answer, v.difference))
    return out, experiments


def beside(found: Sequence[Verdict], experiments: Sequence[Experiment]) -> list[Verdict]:
    """Verdicts with the experiments on their claims."""
    return [dataclasses.replace(v, experiments=tuple(e for e in experiments if v.claim.key and e.key == v.claim.key))
            for v in found]


def _verdict(study: Study, size: str, asked: Asked, found: Mapping[str, Found]) -> Verdict:
    claim = Claim(asked.text, asked.source, asked.figures, study.tasks.get(size, study.name), Side(*asked.better),
                  Side(*asked.worse), asked.metric, asked.equal, asked.note, f"{study.name}/{asked.text}")
    sides = (asked.better, asked.worse)
    command = f"vsfsim study {study.name} --size {size}"
    if any(name not in found for name, _ in sides):
        return Verdict(claim, UNTOLD, "no result", None, (command,))
    values = [found[name].values(asked.metric, shot) for name, shot in sides]
    files = ", ".join(dict.fromkeys(found[name].path.name for name, _ in sides))
    if not all(values):
        return Verdict(claim, UNTOLD, f"no {asked.metric} at these shots", None, (f"{command} ({files})",))
    return Verdict(claim, *decide(claim, *values), (f"{command} ({files})",))
