"""A study's table: values of the variants over objects, and their paired differences from the baseline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from papers.results import Found, on_other_data
from papers.study import Study
from vsfsim.bench.board.compare import Paired, Runs, interval, paired
from vsfsim.bench.leaderboard import interval_text
from vsfsim.bench.result import unit_of
from vsfsim.core.text_table import text_table

RANKING = "5"
"""The shot whose differences stand in a table beside those of the first one, the last one where there is none of it;
JSON has all of them."""


def table(study: Study, found: Mapping[str, Found]) -> dict[str, Any]:
    """The study for JSON.

    Args:
        study: the study. found: results by variant, as `papers.results.stored` gives them.
    """
    rows = []
    for variant in study.variants:
        one, (values, apart) = found.get(variant.name), _measured(study, found, variant.name)
        means = {shot: interval(of) for shot, of in values.items()}
        rows.append({"variant": variant.name, "method": variant.method, "preset": variant.preset,
                     "parameters": dict(variant.set), "paper": dict(variant.paper),
                     "values": {shot: {"mean": of.mean, "error": of.error if of.error == of.error else None,
                                       "objects": of.objects} for shot, of in means.items()},
                     "difference": {shot: {key: v for key, v in asdict(d).items() if np.isfinite(v)}
                                    for shot, d in apart.items()},
                     "file": str(one.path) if one is not None else None})
    return {"study": study.name, "title": study.title, "source": study.source, "metric": study.metric,
            "task": study.task, "baseline": study.baseline, "paper_unit": study.unit, "variants": rows}


def _measured(study: Study, found: Mapping[str, Found], name: str) -> tuple[dict[str, Runs], dict[str, Paired]]:
    """By shot, the values of a variant by object and, where two or more are in common, its difference from the
    baseline."""
    one, base = found.get(name), found.get(study.baseline)
    values = {shot: one.values(study.metric, shot) for shot in labels(study, found)} if one is not None else {}
    apart = {shot: paired(mine, base.values(study.metric, shot)) for shot, mine in values.items()
             } if base is not None and base is not one else {}
    return ({shot: mine for shot, mine in values.items() if mine},
            {shot: difference for shot, difference in apart.items() if difference.objects > 1})


def labels(study: Study, found: Mapping[str, Found]) -> list[str]:
    """Shots that some result has, in order; where the study says which it asks, no others."""
    asked = {*map(str, study.shots), "all"}
    every = {shot for one in found.values() for shot in one.result.shots if not study.shots or shot in asked}
    return sorted(every, key=lambda shot: (shot == "all", int(shot) if shot != "all" else 0))


def cells(study: Study, found: Mapping[str, Found]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table: values, differences from the baseline, the paper's figures."""
    shots, measured = labels(study, found), {v.name: _measured(study, found, v.name) for v in study.variants}
    compared = [shot for shot in shots if any(shot in apart for _, apart in measured.values())]
    compared = list(dict.fromkeys([*compared[:1], *([RANKING] if RANKING in compared else compared[-1:])]))
    said = list(dict.fromkeys(shot for v in study.variants for shot in v.paper))
    head = ["variant", *(f"{shot}-shot" for shot in shots),
            *(f"minus {study.baseline}, {shot}-shot" for shot in compared),
            *(f"paper, {shot}-shot [{study.unit}]" for shot in said)]
    rows = []
    for v in study.variants:
        values, apart = measured[v.name]
        ours = [*(interval_text(values[shot]) if shot in values else "" for shot in shots),
                *(_difference(apart[shot]) if shot in apart else "" for shot in compared)]
        rows.append([v.name, *ours,
                     *(" ± ".join(f"{x:.2f}" for x in np.ravel(v.paper.get(shot, ()))) for shot in said)])
    return head, rows


def title(study: Study, found: Mapping[str, Found]) -> str:
    """One line: what the figures are."""
    of = next(iter(found.values()), None)
    unit = unit_of(study.metric, of.result.unit if of else "") or "-"
    objects = max((len(one.values(study.metric, shot)) for one in found.values() for shot in one.result.shots),
                  default=0)
    return (f"{study.metric} [{unit}], mean ± standard error over objects (at most {objects}), and paired differences "
            f"from '{study.baseline}'; on {study.task}")


def text(study: Study, found: Mapping[str, Found]) -> str:
    """The study for a terminal."""
    lines = [f"{study.name}: {study.title} ({study.source})", title(study, found), "",
             text_table(*cells(study, found)), *remarks(found)]
    missing = [v.name for v in study.variants if v.name not in found]
    if missing:
        lines += ["", f"missing: {', '.join(missing)}; `vsfsim papers study {study.name}` makes them"]
    return "\n".join(lines + (["", study.note] if study.note else []))


def remarks(found: Mapping[str, Found]) -> list[str]:
    """A line for the variants that were made on other data than the first one."""
    other = ", ".join(f"'{name}'" for name in on_other_data(found))
    return [f"made on other data than '{next(iter(found))}': {other}; make them again"] if other else []


def _difference(d: Paired) -> str:
    return f"{d.mean:+.3f} ± {d.error:.3f}{' *' if d.told_apart else ''}"
