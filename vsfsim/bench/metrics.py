"""The table of metrics: what can be scored, of which answer of a method, and by which function.

The harness collects one record for each answer of a method to one object, shot and seed, and asks the table. A new
metric is one row and one function of the records of one seed. Result files name metrics by `Metric.name`.

Readings: y are noise-free, p predictions, in the task's unit. Only valid (converged) frames of query touches count, and
a reading of d numbers counts as d readings. A query touch is reduced to sums first (`touch_errors`), which the result
file keeps; a metric is a function of the sums of several touches.

Stiffness, at the probed points that some touch reached: s are a method's means (k,) in its own unit, k the truth: the
force of a small cone over its displacement (SBML appendix C.4) [N/m]. s has no common unit, so that ranks are compared.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any

import numpy as np

from vsfsim.core.rotation import pose_errors
from vsfsim.core.shelf import Registry

Record = Mapping[str, Any]

FEWEST_POINTS = 3
"""An object with fewer reached points is not scored."""
TIE = 1e-9
"""As a fraction of the largest value. Values closer together share a rank."""


def touch_errors(prediction: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """Sums over one query touch: ``n`` readings, ``sse`` of squared errors.

    Args:
        prediction: (T, d). truth: noise-free readings (T, d). valid: (T,) bool, at least one True.
    """
    error = prediction[valid] - truth[valid]
    return {"n": int(error.size), "sse": float(np.sum(error**2))}


def rmse(touches: Sequence[Record]) -> float:
    """Mean over query touches of sqrt(mean_t (p - y)^2)."""
    return float(np.mean(np.sqrt(_column(touches, "sse") / _column(touches, "n"))))


def rmse_ratio(touches: Sequence[Record]) -> float | None:
    """Mean over objects of `rmse` over that of predicting zero on the same touches; None where a true reading is not
    known, or all those of an object are zero."""
    ratios = object_ratios(touches)
    return None if ratios is None else float(np.mean(list(ratios.values())))


def object_ratios(touches: Sequence[Record]) -> dict[str, float] | None:
    """The ratio of each object, all its views together, by the object's name; None as of `rmse_ratio`.

    Args:
        touches: sums with the names of the object views, ``object``, and the sums of squares of the true readings,
            ``ss`` [unit^2].
    """
    if any(touch.get("ss") is None or touch.get("object") is None for touch in touches):
        return None
    mine: dict[str, list[tuple[float, float]]] = {}
    for touch in touches:
        n = float(touch["n"])
        mine.setdefault(object_of(touch["object"]), []).append((math.sqrt(touch["sse"] / n),
                                                                math.sqrt(touch["ss"] / n)))
    sums = {name: (math.fsum(e for e, _ in pairs), math.fsum(z for _, z in pairs)) for name, pairs in mine.items()}
    if any(not zero > 0.0 for _, zero in sums.values()):
        return None
    return {name: error / zero for name, (error, zero) in sums.items()}


@lru_cache(maxsize=4096)  # a leaderboard asks for each of its rows
def object_of(view: str) -> str:
    """Name of the object of a view: "shoe-0004" of "shoe-0004-v1"."""
    return re.sub(r"-v\d+$", "", view)


def _column(touches: Sequence[Record], name: str) -> np.ndarray:
    return np.array([touch[name] for touch in touches], float)


def can_be_scored(mean: np.ndarray, truth: np.ndarray) -> bool:
    """Whether an object has enough reached points and an estimate that is positive anywhere."""
    return len(truth) >= FEWEST_POINTS and bool(np.any(mean > 0))


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rank correlation of two arrays (k,), ties sharing their mean rank; 0 where one of them is constant.

    Values closer together than `TIE` count as equal: an estimator gives many points one value up to rounding, and
    rounding differs between machines.
    """
    ra, rb = (rank - rank.mean() for rank in (_ranks(a), _ranks(b)))
    norm = np.sqrt((ra @ ra) * (rb @ rb))
    return float(ra @ rb / norm) if norm > 0 else 0.0


def _ranks(values: np.ndarray) -> np.ndarray:
    order = np.argsort(values, kind="stable")
    group = np.zeros(len(values), int)
    group[order[1:]] = np.cumsum(np.diff(values[order]) > TIE * np.abs(values).max(initial=0.0))
    counts = np.bincount(group)
    return (np.cumsum(counts) - (counts - 1) / 2.0)[group]


def mask_scores(value: np.ndarray, stiff: np.ndarray) -> tuple[float, float]:
    """The largest F1 score of ``value >= threshold`` (p,) against ``stiff`` (p,) bool over all thresholds, and
    the recall there; 0 if nothing is stiff. Neural VSF table I chooses a threshold for each method, too."""
    order = np.argsort(-value, kind="stable")
    hit = np.cumsum(stiff[order])
    last = np.append(np.diff(value[order]) != 0.0, True)  # points of one value fall on one side together
    if not stiff.any():
        return 0.0, 0.0
    scores = np.where(last, 2.0 * hit / (np.arange(1, len(hit) + 1) + stiff.sum()), -1.0)
    best = int(np.argmax(scores))
    return float(scores[best]), float(hit[best]) / int(stiff.sum())


class Answer(StrEnum):
    """What a method answers, and what a record of it holds."""

    READINGS = "readings"
    """`predict`. A record is a query touch: the sums of `touch_errors`."""

    STIFFNESS = "stiffness"
    """`stiffness` at the reached probe points. A record is an object: ``mean`` (k,), ``truth`` (k,)
    [N/m]."""

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


def _of_object(name: str, answer: Answer, score: Callable[[Record], float], doc: str, **more: Any) -> Metric:
    """A metric that is the mean over objects of a score of one."""
    return Metric(name, answer, lambda records: float(np.mean([score(record) for record in records])), doc, **more)


def _of_mask(name: str, place: int, doc: str) -> Metric:
    return _of_object(name, Answer.MASK, lambda r: mask_scores(r["value"], r["stiff"])[place], doc,
                      higher_is_better=True, ranks=True)


METRICS: Registry[Metric] = Registry("vsfsim.metrics", {
    m.name: m for m in (
        Metric("rmse", Answer.READINGS, rmse, "Root mean square error of a touch's readings, averaged over touches.",
               unit=None, ranks=True),
        Metric("rmse_ratio", Answer.READINGS, rmse_ratio,
               "Error of an object, `rmse`, over that of predicting zero on the same touches, averaged over objects.",
               ranks=True),
        _of_object("stiffness_spearman", Answer.STIFFNESS, lambda r: spearman(r["mean"], r["truth"]),
                   "Spearman's rank correlation of estimate and truth.", higher_is_better=True),
        _of_mask("mask_f1", 0, "F1 score of the mask of stiff pixels at the best threshold."),
        _of_mask("mask_recall", 1, "Recall of the mask at that threshold."),
        _of_object("translation_error", Answer.POSE,
                   lambda r: 1e3 * pose_errors(r["estimate"], r["truth"])[0],
                   "Distance between the centres of the estimated and the true object.", unit="mm", ranks=True),
        _of_object("rotation_error", Answer.POSE,
                   lambda r: float(np.degrees(pose_errors(r["estimate"], r["truth"])[1])),
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


SUMS = ("touch", "n", "sse")
"""Columns of the rows of `Answer.READINGS` in a result file, besides ``object``, ``shot`` and ``seed``."""


def columns_of(answer: Answer) -> tuple[str, ...]:
    """Names of the columns of an answer's rows in a result file."""
    own = SUMS if answer is Answer.READINGS else tuple(m.name for m in metrics_of(answer))
    return ("object", "shot", "seed", *own)


def score_of_rows(metric: Metric, rows: Sequence[Record]) -> float | None:
    """A metric over the rows of one seed at one shot as a result file keeps them, the sums of touches or the metrics of
    objects; None where a row lacks it."""
    if metric.answer is Answer.READINGS:
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
