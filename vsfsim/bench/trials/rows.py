"""The rows of a result file, and the scores that are computed from them and from nothing else."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.bench.metrics import Answer, Record, columns_of, metrics_of, score_of_rows

Rows = dict[Answer, list[dict[str, Any]]]

READING_COLUMNS = ("object", "touch", "n", "ss")
"""Of `vsfsim.bench.result.Result.readings`."""


MAP_COLUMNS = ("object", "x", "y", "z", "truth", "mean", "std")
"""Of `vsfsim.bench.result.Result.maps`."""

MAP_STEP, MAP_ORIGIN = 1e-4, 30_000
"""A coordinate of a map is a whole number: of steps [m] from -3 m."""


@dataclass(frozen=True)
class Score:
    """A metric at one shot."""

    mean: float
    """Over seeds."""
    std: float
    """Over seeds, with n - 1; 0 for one seed."""
    per_seed: tuple[float, ...]
    """In the order of `Result.seeds`."""

    @classmethod
    def of(cls, per_seed: list[float]) -> Score:
        """From the values of the seeds."""
        n = len(per_seed)
        mean = math.fsum(per_seed) / n
        std = math.sqrt(math.fsum((v - mean) ** 2 for v in per_seed) / (n - 1)) if n > 1 else 0.0
        return cls(mean, std, tuple(per_seed))


def as_columns(answer: Answer, rows: Sequence[Record]) -> dict[str, list]:
    """Rows as the columns of a result file."""
    return {name: [_plain(row.get(name)) for row in rows] for name in columns_of(answer)}


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def stored(rows: Sequence[dict[str, Any]]) -> None:
    """Round the sums of errors to single precision (6e-8), as the results of tasks with cross-validation store them,
    so that scores are those of the stored rows."""
    for row in rows:
        row.update({name: float(np.float32(row[name])) for name in ("sse", "sae", "nll") if name in row})


def beside_zero(rows: Sequence[Record], readings: Mapping[str, Sequence], size: int) -> list[dict[str, Any]]:
    """Rows of `Answer.READINGS` with the sum of squares of the true readings, ``ss``, and the ``size`` d of a reading.

    Args:
        rows: as a result keeps them. readings: `vsfsim.bench.result.Result.readings`, {} if they are not kept.
        size: of a reading.
    """
    known = {(name, touch): ss for name, touch, ss in zip(readings["object"], readings["touch"], readings["ss"],
                                                          strict=True)} if readings else {}
    return [{**row, "ss": known.get((row["object"], row["touch"])), "size": size} for row in rows]


def as_rows(columns: Mapping[str, Sequence]) -> list[dict[str, Any]]:
    """Columns of a result file as rows."""
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def scores_of(answer: Answer, rows: Sequence[Record], labels: tuple[str, ...],
              seeds: tuple[int, ...]) -> dict[str, dict[str, Score]]:
    """The metrics of one kind of answer, by metric and shot.

    A shot at which some seed has no row is left out, and so is a metric that a row lacks something for.

    Args:
        answer: what was asked. rows: as a result file keeps them. labels, seeds: of the result.
    """
    parts: dict[tuple[str, int], list[Record]] = {(label, seed): [] for label in labels for seed in seeds}
    for row in rows:
        parts.setdefault((row["shot"], row["seed"]), []).append(row)
    out: dict[str, dict[str, Score]] = {}
    for label in labels:
        of_seeds = [parts[label, seed] for seed in seeds]
        for metric in metrics_of(answer) if all(of_seeds) else ():
            values = [score_of_rows(metric, part) for part in of_seeds]
            known = [value for value in values if value is not None]
            if len(known) == len(values):
                out.setdefault(metric.name, {})[label] = Score.of(known)
    return out
