"""The functions of the table of metrics (`vsfsim.bench.metrics`): errors of predicted readings, of a stiffness, of a
mask and of a pose, and of the standard deviations given with them.

Readings: y are noise-free, p predictions, s their standard deviations, all in the task's unit. Only valid (converged)
frames of query touches count, and a reading of d numbers counts as d readings. A query touch is reduced to sums first
(`touch_errors`, `touch_uncertainty`); a metric is a function of the sums of several touches. The result file keeps the
sums of `touch_errors`.

Stiffness, at the probed points that some touch reached: s are a method's means (k,) in its own unit, t their standard
deviations, k the truth: the force of a small cone over its displacement (SBML appendix C.4) [N/m]. Because s has no
common unit, one scale an object is allowed (`scale_of`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from vsfsim.core.rotation import pose_errors

Sums = Sequence[Mapping[str, Any]]

HALF_WIDTH_50, HALF_WIDTH_90 = 0.6744897501960817, 1.6448536269514722
"""Half-widths of the central 50 % and 90 % of a normal distribution, in standard deviations."""

SMALLEST_STD = 1e-6
"""In the unit of the reading. A smaller standard deviation counts as this one, so that the likelihood stays finite."""


def touch_errors(prediction: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """Sums over one query touch: ``n`` readings, ``sse`` of squared errors, ``sae`` of absolute errors.

    Args:
        prediction: (T, d). truth: noise-free readings (T, d). valid: (T,) bool, at least one True.
    """
    error = prediction[valid] - truth[valid]
    return {"n": int(error.size), "sse": float(np.sum(error**2)), "sae": float(np.sum(np.abs(error)))}


def touch_uncertainty(prediction: np.ndarray, std: np.ndarray, truth: np.ndarray,
                      valid: np.ndarray) -> dict[str, float]:
    """Sums over one query touch: ``n`` readings, ``nll`` of negative log-likelihoods, and the numbers ``in50`` and
    ``in90`` of readings inside the central 50 % and 90 %.

    Args:
        prediction, std, truth: (T, d). valid: (T,) bool, at least one True.
    """
    error, s = np.abs(prediction - truth)[valid], np.maximum(std[valid], SMALLEST_STD)
    return {"n": int(error.size), "nll": float(np.sum(negative_log_likelihood(error, s))),
            "in50": int(np.sum(error <= HALF_WIDTH_50 * s)), "in90": int(np.sum(error <= HALF_WIDTH_90 * s))}


def rmse(touches: Sums) -> float:
    """Mean over query touches of sqrt(mean_t (p - y)^2)."""
    return float(np.mean(np.sqrt(_column(touches, "sse") / _column(touches, "n"))))


def rmse_pooled(touches: Sums) -> float:
    """sqrt(mean over all readings of all query touches of (p - y)^2)."""
    return float(np.sqrt(_column(touches, "sse").sum() / _column(touches, "n").sum()))


def rmse_norm(touches: Sums) -> float | None:
    """Mean over query touches of sqrt(mean_t |p - y|^2), |.| the norm of the d numbers of a reading; None for d = 1,
    where it is `rmse`, and where d is not known."""
    size = touches[0].get("size") or 1
    return None if size == 1 else float(np.sqrt(size)) * rmse(touches)


def rmse_ratio(touches: Sums) -> float | None:
    """Mean over objects of `rmse` over that of predicting zero on the same touches; None where a true reading is not
    known, or all those of an object are zero."""
    ratios = object_ratios(touches)
    return None if ratios is None else float(np.mean(list(ratios.values())))


def object_ratios(touches: Sums) -> dict[str, float] | None:
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


def mae(touches: Sums) -> float:
    """Mean over query touches of mean_t |p - y|."""
    return float(np.mean(_column(touches, "sae") / _column(touches, "n")))


def mae_pooled(touches: Sums) -> float:
    """Mean over all readings of all query touches of |p - y|."""
    return float(_column(touches, "sae").sum() / _column(touches, "n").sum())


def mean_of(sums: str) -> Callable[[Sums], float]:
    """The metric that is the sum called ``sums`` over the number of readings."""
    return lambda touches: sum(touch[sums] for touch in touches) / sum(touch["n"] for touch in touches)


def negative_log_likelihood(error: np.ndarray, std: np.ndarray) -> np.ndarray:
    """1/2 (e / s)^2 + log s + 1/2 log 2 pi of a normal distribution, entry by entry."""
    return 0.5 * (error / std) ** 2 + np.log(std) + 0.5 * np.log(2.0 * np.pi)


def _column(touches: Sums, name: str) -> np.ndarray:
    return np.array([touch[name] for touch in touches], float)


FEWEST_POINTS = 3
"""An object with fewer reached points is not scored."""

SMALLEST_SHARE = 1e-3
"""As a fraction of the median truth. A smaller standard deviation counts as this one, so that the likelihood stays
finite."""

TIE = 1e-9
"""As a fraction of the largest value. Values closer together share a rank."""


def can_be_scored(mean: np.ndarray, truth: np.ndarray) -> bool:
    """Whether an object has enough reached points and an estimate that is positive anywhere."""
    return len(truth) >= FEWEST_POINTS and bool(np.any(mean > 0))


def log10_error(mean: np.ndarray, truth: np.ndarray) -> float:
    """Mean |log10 s - log10 k - c| with the scale c; an s at or near 0 counts as a tenth of the softest k times that
    scale."""
    scale = scale_of(mean, truth)
    floor = 0.1 * truth.min() * 10.0**scale
    return float(np.abs(np.log10(np.maximum(mean, floor)) - np.log10(truth) - scale).mean())


def uncertainty(mean: np.ndarray, std: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Absolute errors (k,) and standard deviations (k,) [N/m] after the scale c on both."""
    scale = 10.0 ** -scale_of(mean, truth)
    return np.abs(scale * mean - truth), np.maximum(scale * std, SMALLEST_SHARE * float(np.median(truth)))


def within(half_width: float) -> Callable[[np.ndarray, np.ndarray], float]:
    """The fraction of absolute errors (k,) within so many standard deviations (k,)."""
    return lambda error, std: float(np.mean(error <= half_width * std))


def scale_of(estimate: np.ndarray, truth: np.ndarray) -> float:
    """The one allowed scale c [decades]: the median of log10 s - log10 k over s > 0, of which there must be one."""
    positive = estimate > 0
    return float(np.median(np.log10(estimate[positive]) - np.log10(truth[positive])))


def stiff_points(truth: np.ndarray) -> np.ndarray:
    """Which of the stiffnesses ``truth`` (k,) > 0 belong to the stiff one of two classes (k,) bool; none if all are
    equal. The classes are those whose mean log10 k differs most (Otsu 1979)."""
    order = np.sort(np.log10(truth))
    count = np.arange(1, len(order))
    below = np.cumsum(order)[:-1] / count
    above = (order.sum() - np.cumsum(order)[:-1]) / (len(order) - count)
    between = count * (len(order) - count) * (above - below) ** 2
    if len(order) < 2 or not between.max() > 0.0:
        return np.zeros(len(truth), bool)
    return np.log10(truth) > order[int(np.argmax(between))]


def best_f1(estimate: np.ndarray, positive: np.ndarray) -> float:
    """Largest F1 score of ``estimate >= threshold`` against ``positive`` (k,) bool over all thresholds; 0 if nothing is
    positive. Neural VSF table I chooses a threshold for each method, too."""
    return best_threshold(estimate, positive)[0]


def best_threshold(estimate: np.ndarray, positive: np.ndarray) -> tuple[float, float]:
    """The F1 score of `best_f1` and its threshold; (0, inf) if nothing is positive."""
    order = np.argsort(-estimate, kind="stable")
    hit = np.cumsum(positive[order])
    last = np.append(np.diff(estimate[order]) != 0.0, True)  # points of one value fall on one side together
    if not positive.any():
        return 0.0, float("inf")
    scores = np.where(last, 2.0 * hit / (np.arange(1, len(hit) + 1) + positive.sum()), -1.0)
    best = int(np.argmax(scores))
    return float(scores[best]), float(estimate[order][best])


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rank correlation of two arrays (k,), ties sharing their mean rank; 0 where one of them is constant.

    Values closer together than `TIE` count as equal: an estimator gives many points one value up to rounding, and
    rounding differs between machines.
    """
    ra, rb = _ranks(a), _ranks(b)
    ra, rb = ra - ra.mean(), rb - rb.mean()
    norm = np.sqrt((ra @ ra) * (rb @ rb))
    return float(ra @ rb / norm) if norm > 0 else 0.0


def _ranks(values: np.ndarray) -> np.ndarray:
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    group = np.zeros(len(values), int)
    group[order[1:]] = np.cumsum(np.diff(ordered) > TIE * np.abs(values).max(initial=0.0))
    counts = np.bincount(group)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2.0)[group]


def mask_scores(value: np.ndarray, stiff: np.ndarray) -> tuple[float, float, float]:
    """The best F1 score of ``value >= threshold`` (p,) against ``stiff`` (p,) bool, and precision and recall there."""
    f1, threshold = best_threshold(value, stiff)
    found = value >= threshold
    right = float((found & stiff).sum())
    return f1, right / max(int(found.sum()), 1), right / max(int(stiff.sum()), 1)


def translation_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Distance [mm] between the origins of two poses (4, 4)."""
    return 1e3 * pose_errors(estimate, truth)[0]


def rotation_error(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Angle [deg] of the rotation between two poses (4, 4)."""
    return float(np.degrees(pose_errors(estimate, truth)[1]))
