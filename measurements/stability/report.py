"""The stability map in numbers, as a table and as a picture."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Table
from measurements.stability.design import KINDS, Cell, Level
from measurements.stability.judge import LATE, Outcome, Verdict

SIMILAR = 1e-3  # relative difference of a force that the scaling of units forbids (float64)
SPANS = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 60.0)  # times of a frame that the report tells apart [s]
_PAIRS = (("probe", "depth"), ("poisson", "depth"), ("contrast", "depth"), ("friction", "depth"), ("size", "young"),
          ("thickness", "depth"), ("tier", "element"), ("frames", "depth"))


def scaled(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The verdicts, with those that contradict the scaling of units called wrong.

    Without weight a force is proportional to the modulus and to the square of the size. Cells that differ from the
    default only by modulus or size must give the default's forces, scaled.
    """
    base = next((v for v in verdicts if v.cell.kind == "solid" and v.cell.text == "solid: defaults"), None)
    if base is None or base.outcome is not Outcome.CONVERGED:
        return list(verdicts)
    out = []
    for v in verdicts:
        f, changed = v.cell.factors, _changed(v.cell)
        if (v.outcome is Outcome.CONVERGED and v.cell.kind == "solid" and changed and changed <= {"young", "size"}):
            factor = (float(f["young"]) / float(base.cell.factors["young"])
                      * (float(f["size"]) / float(base.cell.factors["size"])) ** 2)
            error = max(abs((a or 0.0) / (factor * (b or 1.0)) - 1.0) for a, b in zip(v.push, base.push, strict=True))
            if error > SIMILAR:
                words = f"the forces differ by {100 * error:.2g} % from those of the default cell, scaled"
                v = dataclasses.replace(v, outcome=Outcome.WRONG, words=(words,))
        out.append(v)
    return out


def _changed(cell: Cell) -> set[str]:
    return {f.name for f in KINDS[cell.kind] if cell.factors[f.name] != f.default}


def measurement(verdicts: Sequence[Verdict], settings: dict[str, Any], notes: Sequence[str] = ()) -> Measurement:
    """Shares of the outcomes, and every cell that is not converged, with notes on how they were made."""
    rows = [_shares("all cells", verdicts),
            _shares("friction <= 1, depth <= 50 %", [v for v in verdicts if v.cell.moderate]),
            *(_shares(kind, [v for v in verdicts if v.cell.kind == kind]) for kind in KINDS)]
    reasons = Counter(reason for v in verdicts for reason in v.reasons)
    columns = (Column("cells", "cells"), Column("number", "number", "1", form="d"),
               *(Column(o.value, o.value, "1", "%", ".1f") for o in Outcome))
    tables = [Table("Share of the cells by outcome, in percent", columns, rows, "shares")]
    if reasons:
        tables.append(Table("Cells with frames that are marked, by reason",
                            (Column("reason", "reason"), Column("number", "cells", "1", form="d")),
                            [{"reason": reason, "number": n} for reason, n in reasons.most_common()], "reasons"))
    limit = settings.get("limit")
    if limit:
        spans = [span for span in SPANS if span < limit] + [limit]
        timed = [v for v in verdicts if v.cell.kind in ("solid", "bubble")]
        tables.append(Table("Share of solids and bubbles all of whose frames converge within a time, in percent",
                            (Column("cells", "cells"), Column("number", "number", "1", form="d"),
                             *(Column(f"within_{1e3 * span:g}_ms", f"{span:g} s", "1", "%", ".1f") for span in spans)),
                            [_within("all", timed, spans),
                             _within("friction <= 1, depth <= 50 %", [v for v in timed if v.cell.moderate], spans)],
                            "within"))
    worse = [v for v in verdicts if v.outcome in (Outcome.WRONG, Outcome.CRASHED, Outcome.LATE)]
    if worse:
        tables.append(Table("Cells that are wrong, crashed or over the limit",
                            (Column("key", "key"), Column("outcome", "outcome"), Column("cell", "cell"),
                             Column("words", "why")),
                            [{"key": v.cell.key, "outcome": v.outcome.value, "cell": v.cell.text,
                              "words": " | ".join(v.words[:2])} for v in worse], "worse"))
    unchecked = Counter(v.unchecked for v in verdicts if v.unchecked)
    if unchecked:
        tables.append(Table("Sampled cells whose second press was refused, by reason",
                            (Column("reason", "reason"), Column("number", "cells", "1", form="d")),
                            [{"reason": reason, "number": n} for reason, n in unchecked.most_common()], "unchecked"))
    return Measurement.of("stability", settings, tables,
                          numbers={"cells": [v.table() for v in verdicts],
                                   "seconds": sum(v.seconds for v in verdicts)},
                          notes=["a cell is converged if all its frames are, marked if one is marked; it is wrong in "
                                 "silence if a frame that is called converged contradicts a check of "
                                 "measurements/stability/checks.py", *notes])


def _shares(name: str, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    count = Counter(v.outcome for v in verdicts)
    return {"cells": name, "number": len(verdicts),
            **{o.value: count[o] / len(verdicts) if verdicts else None for o in Outcome}}


def _within(name: str, verdicts: Sequence[Verdict], spans: Sequence[float]) -> dict[str, Any]:
    good = np.array([v.slowest if v.outcome is Outcome.CONVERGED else np.inf for v in verdicts])
    return {"cells": name, "number": len(verdicts),
            # a step that has begun may end after the limit
            **{f"within_{1e3 * span:g}_ms": float(np.mean(good <= (LATE if span == spans[-1] else 1.0) * span))
               if len(good) else None for span in spans}}


def picture(verdicts: Sequence[Verdict], file: Path) -> None:
    """Draw heat maps of solids over pairs of factors, and bars of every kind (PNG)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    solids = [v for v in verdicts if v.cell.kind == "solid"]
    figure, axes = plt.subplots(3, 3, figsize=(17, 13), layout="constrained")
    for axis, (down, across) in zip(axes.flat, _PAIRS):
        rows, columns = (next(f.levels for f in KINDS["solid"] if f.name == name) for name in (down, across))
        share, number, wrong = (np.zeros((len(rows), len(columns))) for _ in range(3))
        for i, a in enumerate(rows):
            for j, b in enumerate(columns):
                here = [v for v in solids if v.cell.factors[down] == a and v.cell.factors[across] == b]
                number[i, j] = len(here)
                share[i, j] = np.mean([v.outcome is Outcome.CONVERGED for v in here]) if here else np.nan
                wrong[i, j] = sum(v.outcome == Outcome.WRONG for v in here)
        shown = axis.imshow(100.0 * share, cmap="RdYlGn", vmin=0.0, vmax=100.0, aspect="auto")
        axis.set_xticks(range(len(columns)), _labels(columns), rotation=30)
        axis.set_yticks(range(len(rows)), _labels(rows))
        axis.set_xlabel(across)
        axis.set_ylabel(down)
        for i, j in np.ndindex(number.shape):
            if number[i, j]:
                between = " " if len(rows) > 10 else "\n"  # rows too low for three lines
                bad = f"\n{wrong[i, j]:.0f} wrong" if wrong[i, j] else ""
                axis.text(j, i, f"{100 * share[i, j]:.0f} %{between}of {number[i, j]:.0f}{bad}",
                          ha="center", va="center", fontsize=6 if len(rows) > 10 else 7,
                          color="black" if 0.15 < share[i, j] < 0.85 else "white",
                          fontweight="bold" if bad else "normal")
    figure.colorbar(shown, ax=axes[:, -1], label="cells of solids that converge [%]", shrink=0.5)
    _bars(axes.flat[len(_PAIRS)], verdicts)
    figure.suptitle(f"Stability map: {len(verdicts)} cells; share that converges in all frames, over pairs of factors")
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _bars(axis: Any, verdicts: Sequence[Verdict]) -> None:
    colours = ("tab:green", "tab:blue", "gold", "tab:orange", "tab:purple", "tab:red")
    left = np.zeros(len(KINDS))
    totals = [max(1, sum(v.cell.kind == kind for v in verdicts)) for kind in KINDS]
    for outcome, colour in zip(Outcome, colours, strict=True):
        width = [100.0 * sum(v.outcome is outcome for v in verdicts if v.cell.kind == kind) / total
                 for kind, total in zip(KINDS, totals, strict=True)]
        axis.barh(list(KINDS), width, left=left, color=colour, label=outcome.value)
        left += width
    axis.set_xlabel("cells [%]")
    axis.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _labels(levels: Iterable[Level]) -> list[str]:
    return [f"{level:g}" if isinstance(level, float) else level for level in levels]
