"""A study's table: values of the variants over objects, and their paired differences from the baseline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from papers.results import Found, differences
from papers.study import Study
from vsfsim.bench.board.compare import Paired, interval, paired
from vsfsim.bench.leaderboard import Board, unit_of
from vsfsim.core.text_table import text_table

RANKING = "5"
"""The shot whose differences stand in a table beside those of the first one, the last one where there is none of it;
JSON has all of them."""


def table(study: Study, size: str, found: Mapping[str, Found]) -> dict[str, Any]:
    """The study for JSON.

    Args:
        study: the study. size: of its tasks. found: results by variant, as `papers.results.stored` gives
        them.
    """
    rows = []
    for variant in study.variants:
        one, base = found.get(variant.name), found.get(study.baseline)
        values, apart = {}, {}
        for shot in labels(study, found) if one is not None else ():
            assert one is not None
            mine = one.values(study.metric, shot)
            if mine:
                mean, error = interval(mine)
                values[shot] = {"mean": mean, "error": error if error == error else None, "objects": len(mine)}
                if base is not None and base is not one:
                    d = paired(mine, base.values(study.metric, shot))
                    apart[shot] = {"mean": d.mean, "error": d.error, "objects": d.objects} if d.objects > 1 else None
        rows.append({"variant": variant.name, "method": variant.method, "preset": variant.preset,
                     "parameters": dict(variant.set), "values": values, "difference": apart,
                     "paper": dict(variant.paper),
                     "file": str(one.path) if one is not None else None,
                     "task": one.result.task if one is not None else None})
    return {"study": study.name, "title": study.title, "source": study.source, "metric": study.metric, "size": size,
            "baseline": study.baseline, "paper_unit": study.unit, "variants": rows}


def labels(study: Study, found: Mapping[str, Found]) -> list[str]:
    """Shots that some result has, in order; where the study says which it asks, no others."""
    asked = {*map(str, study.shots), "all"}
    every = list(dict.fromkeys(shot for one in found.values() for shot in one.result.shots
                               if not study.shots or shot in asked))
    return sorted(every, key=lambda shot: (shot == "all", int(shot) if shot != "all" else 0))


def cells(study: Study, found: Mapping[str, Found]) -> tuple[list[str], list[list[str]]]:
    """Head and rows of the table: values, differences from the baseline, the paper's figures."""
    data, shots = table(study, "", found), labels(study, found)
    base = study.baseline
    compared = [s for s in shots if any(row["difference"].get(s) for row in data["variants"])]
    compared = list(dict.fromkeys([*compared[:1], *([RANKING] if RANKING in compared else compared[-1:])]))
    said = list(dict.fromkeys(shot for v in study.variants for shot in v.paper))
    head = ["variant", *(f"{s}-shot" for s in shots), *(f"minus {base}, {s}-shot" for s in compared),
            *(f"paper, {s}-shot [{study.unit}]" for s in said)]
    rows = []
    for row in data["variants"]:
        paper = [_paper(row["paper"].get(shot)) for shot in said]
        if row["file"] is None:
            rows.append([row["variant"], *("missing" if k == 0 else "" for k in range(len(shots) + len(compared))),
                         *paper])
            continue
        rows.append([row["variant"], *(_value(row["values"].get(s)) for s in shots),
                     *(_difference(row["difference"].get(s)) for s in compared), *paper])
    return head, rows


def title(study: Study, size: str, found: Mapping[str, Found]) -> str:
    """One line: what the figures are."""
    of = next(iter(found.values()), None)
    unit = unit_of(study.metric, of.result.unit if of else "") or "-"
    objects = max((len(one.values(study.metric, shot)) for one in found.values() for shot in one.result.shots),
                  default=0)
    return (f"{study.metric} [{unit}], mean ± standard error over objects (at most {objects}), and paired differences "
            f"from '{study.baseline}'; size {size}")


def text(study: Study, size: str, found: Mapping[str, Found], boards: dict[str, Board] | None = None) -> str:
    """The study for a terminal; ``boards`` as of `papers.results.stored`."""
    lines = [f"{study.name}: {study.title} ({study.source})"]
    head, rows = cells(study, found)
    lines += [title(study, size, found), "", text_table(head, rows)]
    lines += on_other_data(found, {} if boards is None else boards)
    missing = [v.name for v in study.variants if v.name not in found]
    if missing:
        lines += ["", f"missing: {', '.join(missing)}; `vsfsim papers study {study.name} --size {size}` makes them"]
    if study.note:
        lines += ["", study.note]
    return "\n".join(lines)


def on_other_data(found: Mapping[str, Found], boards: dict[str, Board]) -> list[str]:
    """A line for earlier rows, one for the variants that were made on other data than the first one, and one for those
    that were made on the same data, made again; ``boards`` as of `papers.results.stored`."""
    earlier = ", ".join(f"'{name}'" for name, one in found.items() if not one.stands)
    lines = {f"earlier rows, of a method or a scorer that is gone: {earlier}; no claim rests on them": earlier}
    odd, first = differences(found, boards) if len(found) > 1 else {}, next(iter(found), "")
    other, again = (", ".join(f"'{name}'" for name in odd if odd[name] is kind) for kind in (True, False))
    lines |= {f"made on other data than '{first}': {other}; make them again": other,
              f"on the data of '{first}' made again by a machine that rounds otherwise: {again}": again}
    return [line for line, names in lines.items() if names]


def _value(value: Mapping[str, Any] | None) -> str:
    if value is None:
        return ""
    return f"{value['mean']:.3f}" + (f" ± {value['error']:.3f}" if value["error"] is not None else "")


def _difference(value: Mapping[str, Any] | None) -> str:
    if value is None:
        return ""
    d = Paired(value["mean"], value["error"], value["objects"])
    return f"{d.mean:+.3f} ± {d.error:.3f}{' *' if d.told_apart else ''}"


def _paper(value: float | tuple[float, float] | None) -> str:
    if value is None:
        return ""
    return " ± ".join(f"{v:.2f}" for v in (value if isinstance(value, tuple) else (value,)))
