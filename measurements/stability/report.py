"""The stability map in numbers."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any

from measurements.measurement import Column, Measurement, Table
from measurements.stability.design import KINDS
from measurements.stability.judge import BAD, Outcome, Verdict

SIMILAR = 1e-3  # relative difference of a force that the scaling of units forbids (float64)



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
        f = v.cell.factors
        changed = {one.name for one in KINDS[v.cell.kind] if f[one.name] != one.default}
        if (v.outcome is Outcome.CONVERGED and v.cell.kind == "solid" and changed and changed <= {"young", "size"}):
            factor = (float(f["young"]) / float(base.cell.factors["young"])
                      * (float(f["size"]) / float(base.cell.factors["size"])) ** 2)
            error = max(abs((a or 0.0) / (factor * (b or 1.0)) - 1.0) for a, b in zip(v.push, base.push, strict=True))
            if error > SIMILAR:
                words = f"the forces differ by {100 * error:.2g} % from those of the default cell, scaled"
                v = dataclasses.replace(v, outcome=Outcome.WRONG, words=(words,))
        out.append(v)
    return out


def measurement(verdicts: Sequence[Verdict], settings: dict[str, Any]) -> Measurement:
    """Shares of the outcomes, and every cell that is not converged."""
    rows = [_shares("all cells", verdicts),
            _shares("friction <= 1, depth <= 50 %", [v for v in verdicts if v.cell.moderate]),
            *(_shares(kind, [v for v in verdicts if v.cell.kind == kind]) for kind in KINDS)]
    reasons = Counter(reason for v in verdicts for reason in v.reasons)
    columns = (Column("cells", "cells"), Column("number", "number", "1", form="d"),
               *(Column(o.value, o.value, "1", "%", ".1f") for o in Outcome))
    tables = [Table("Share of the cells by outcome, in percent", columns, rows, "shares")]
    counted = [Table(title, (Column("reason", "reason"), Column("number", "cells", "1", form="d")),
                     [{"reason": reason, "number": n} for reason, n in count.most_common()], name)
               for title, name, count in (
                   ("Cells with frames that are marked, by reason", "reasons", reasons),
                   ("Sampled cells whose second press was refused, by reason", "unchecked",
                    Counter(v.unchecked for v in verdicts if v.unchecked))) if count]
    tables += counted
    worse = [v for v in verdicts if v.outcome in BAD]
    if worse:
        tables.append(Table("Cells that are wrong, crashed or over the limit",
                            (Column("key", "key"), Column("outcome", "outcome"), Column("cell", "cell"),
                             Column("words", "why")),
                            [{"key": v.cell.key, "outcome": v.outcome.value, "cell": v.cell.text,
                              "words": " | ".join(v.words[:2])} for v in worse], "worse"))
    return Measurement.of("stability", settings, tables,
                          numbers={"cells": [v.table() for v in verdicts],
                                   "seconds": sum(v.seconds for v in verdicts)},
                          notes=[
        "a cell is converged if all its frames are and its mesh resolves them, not resolved if it does not resolve "
        "one, marked if one did not converge; it is wrong in silence if a frame that is called converged contradicts "
        "a check of measurements/stability/checks.py"])


def _shares(name: str, verdicts: Sequence[Verdict]) -> dict[str, Any]:
    count = Counter(v.outcome for v in verdicts)
    return {"cells": name, "number": len(verdicts),
            **{o.value: count[o] / len(verdicts) if verdicts else None for o in Outcome}}
