"""The table of metrics: what can be scored, of which answer of a method, and by which function.

The harness collects one record for each answer of a method to one object, shot and seed, and asks the table. A new
metric is one row and one function of the records of one seed. Result files name metrics by `Metric.name`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from vsfsim.bench import metric_functions as functions
from vsfsim.core.shelf import Registry

Record = Mapping[str, Any]


class Answer(StrEnum):
    """What a method answers, and what a record of it holds."""

    READINGS = "readings"
    """`predict`. A record is a query touch: the sums of `metric_functions.touch_errors`."""

    READING_STD = "reading std"
    """`predict_std`. A record is a query touch: the sums of `metric_functions.touch_uncertainty`."""

    STIFFNESS = "stiffness"
    """`stiffness` at the reached probe points. A record is an object: ``mean`` (k,), ``std`` (k,) or None where the
    method gives none, ``truth`` (k,) [N/m]."""

    MASK = "mask"
    """`stiffness` under the pixels of a mask. A record is an object: ``value`` (p,) of the pixels, ``stiff`` (p,) bool,
    see `inclusions.Columns`."""

    POSE = "pose"
    """`locate`. A record is an object: ``estimate`` and ``truth``, object-to-world transforms (4, 4)."""


@dataclass(frozen=True)
class Metric:
    """One row of the table."""
    name: str
    """As tasks and result files write it."""
    answer: Answer
    """What is scored."""
    score: Callable[[Sequence[Record]], float | None]
    """(the records of one seed at one shot, at least one) -> score; None where a record lacks what it needs."""
    doc: str
    """One sentence."""
    unit: str | None = ""
    """Of the score; None for the unit of the task's readings, "" for a pure number."""
    higher_is_better: bool = False
    """The direction of a ranking."""
    ranks: bool = False
    """A task may rank methods by it."""


def _mean_over_objects(score: Callable[..., float], *keys: str) -> Callable[[Sequence[Record]], float]:
    """The mean over objects of ``score``, called with the entries ``keys`` of a record."""
    return lambda records: float(np.mean([score(*(record[key] for key in keys)) for record in records]))


def _mean_uncertainty(score: Callable[[np.ndarray, np.ndarray], float]) -> Callable[[Sequence[Record]], float | None]:
    """The mean over objects of ``score(error, std)``; None where a method gives an object no standard deviation."""
    def mean(records: Sequence[Record]) -> float | None:
        if any(record["std"] is None or not np.any(record["std"] > 0) for record in records):
            return None
        return float(np.mean([score(*functions.uncertainty(r["mean"], r["std"], r["truth"])) for r in records]))
    return mean


def _reading(name: str, score: Callable[[Sequence[Record]], float | None], doc: str) -> Metric:
    return Metric(name, Answer.READINGS, score, doc, unit=None, ranks=True)


def _of_mask(name: str, place: int, doc: str) -> Metric:
    return Metric(name, Answer.MASK, _mean_over_objects(lambda *mask: functions.mask_scores(*mask)[place], "value",
                                                        "stiff"), doc, higher_is_better=True, ranks=True)


METRICS: Registry[Metric] = Registry("vsfsim.metrics", {
    m.name: m for m in (
        _reading("rmse", functions.rmse, "Root mean square error of a touch's readings, averaged over touches."),
        _reading("rmse_pooled", functions.rmse_pooled, "Root mean square error over all functions."),
        Metric("rmse_ratio", Answer.READINGS, functions.rmse_ratio,
               "Error of an object, `rmse`, over that of predicting zero on the same touches, averaged over objects.",
               ranks=True),
        Metric("rmse_norm", Answer.READINGS, functions.rmse_norm,
               "`rmse` of the norm of the error of a reading of several numbers; of torques, of the norm of all seven.",
               unit=None, ranks=True),
        _reading("mae", functions.mae, "Mean absolute error of a touch's readings, averaged over touches."),
        _reading("mae_pooled", functions.mae_pooled, "Mean absolute error over all functions."),
        Metric("nll", Answer.READING_STD, functions.mean_of("nll"),
               "Mean negative log-likelihood of the readings; a std that is too small and one that is too large both "
               "increase it."),
        Metric("coverage50", Answer.READING_STD, functions.mean_of("in50"),
               "Fraction of readings within 0.674 std of the prediction; 0.5 is right."),
        Metric("coverage90", Answer.READING_STD, functions.mean_of("in90"),
               "Fraction of readings within 1.645 std of the prediction; 0.9 is right."),
        Metric("stiffness_spearman", Answer.STIFFNESS, _mean_over_objects(functions.spearman, "mean", "truth"),
               "Spearman's rank correlation of estimate and truth.", higher_is_better=True),
        Metric("stiffness_log10", Answer.STIFFNESS, _mean_over_objects(functions.log10_error, "mean", "truth"),
               "Mean absolute error of log10 of the stiffness after one scale an object."),
        Metric("stiffness_f1", Answer.STIFFNESS,
               _mean_over_objects(lambda mean, truth: functions.best_f1(mean, functions.stiff_points(truth)), "mean",
                                  "truth"),
               "Best F1 score of a threshold that separates the stiff points from the soft ones.",
               higher_is_better=True),
        Metric("stiffness_nll", Answer.STIFFNESS,
               _mean_uncertainty(lambda *given: float(np.mean(functions.negative_log_likelihood(*given)))),
               "Mean negative log-likelihood of the stiffness after one scale an object."),
        Metric("stiffness_coverage50", Answer.STIFFNESS, _mean_uncertainty(functions.within(functions.HALF_WIDTH_50)),
               "Fraction of points within 0.674 std of the estimate; 0.5 is right."),
        Metric("stiffness_coverage90", Answer.STIFFNESS, _mean_uncertainty(functions.within(functions.HALF_WIDTH_90)),
               "Fraction of points within 1.645 std of the estimate; 0.9 is right."),
        Metric("stiffness_std_spearman", Answer.STIFFNESS, _mean_uncertainty(functions.spearman),
               "Spearman's rank correlation of absolute error and std.", higher_is_better=True),
        _of_mask("mask_f1", 0, "F1 score of the mask of stiff pixels at the best threshold."),
        _of_mask("mask_precision", 1, "Precision of the mask at that threshold."),
        _of_mask("mask_recall", 2, "Recall of the mask at that threshold."),
        Metric("translation_error", Answer.POSE, _mean_over_objects(functions.translation_error, "estimate", "truth"),
               "Distance between the centres of the estimated and the true object.", unit="mm", ranks=True),
        Metric("rotation_error", Answer.POSE, _mean_over_objects(functions.rotation_error, "estimate", "truth"),
               "Angle of the rotation between the estimated and the true object.", unit="deg", ranks=True),
    )
})
"""The table, by name, in the order in which results list them; a package adds rows by entry points of the group
``vsfsim.metrics``."""


def metrics_of(answer: Answer) -> tuple[Metric, ...]:
    """The rows that score ``answer``."""
    return tuple(metric for metric in METRICS.values() if metric.answer is answer)


def record_scores(answer: Answer, records: Sequence[Record]) -> dict[str, float | None]:
    """Every metric of ``answer`` over the records of one seed at one shot, by name."""
    return {metric.name: metric.score(records) for metric in metrics_of(answer)}


PER_OBJECT = (Answer.STIFFNESS, Answer.MASK, Answer.POSE)
"""Answers whose metrics are means over objects. Their row in a result file is one object, and holds its metrics."""

SUMS = {Answer.READINGS: ("touch", "n", "sse", "sae"), Answer.READING_STD: ("touch", "n", "nll", "in50", "in90")}
"""Columns of the rows of the other answers in a result file, besides ``object``, ``shot`` and ``seed``."""


def columns_of(answer: Answer) -> tuple[str, ...]:
    """Names of the columns of an answer's rows in a result file."""
    own = tuple(m.name for m in metrics_of(answer)) if answer in PER_OBJECT else SUMS[answer]
    return ("object", "shot", "seed", *own)


def score_of_rows(metric: Metric, rows: Sequence[Record]) -> float | None:
    """A metric over the rows of one seed at one shot as a result file keeps them; None where a row lacks it."""
    if metric.answer not in PER_OBJECT:
        return metric.score(rows)
    values = [row[metric.name] for row in rows if row.get(metric.name) is not None]
    return float(np.mean(values)) if len(values) == len(rows) else None


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
