"""How well a stiffness estimate agrees with the true probe stiffness, at the probed points that some touch reached.

s are a method's means (k,) in its own unit, t their standard deviations, k the truth: the force of a small cone over
its displacement (SBML appendix C.4) [N/m]. Because s has no common unit, one scale an object is allowed (`scale_of`).
"""

from __future__ import annotations

import numpy as np

from vsfsim.bench.reading_metrics import HALF_WIDTH_50, HALF_WIDTH_90, negative_log_likelihood

FEWEST_POINTS = 3
"""An object with fewer reached points is not scored."""

SMALLEST_STD = 1e-3
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
    return np.abs(scale * mean - truth), np.maximum(scale * std, SMALLEST_STD * float(np.median(truth)))


def log_likelihood_loss(error: np.ndarray, std: np.ndarray) -> float:
    """Mean negative log-likelihood."""
    return float(np.mean(negative_log_likelihood(error, std)))


def coverage50(error: np.ndarray, std: np.ndarray) -> float:
    """Fraction of the truths inside the central 50 %."""
    return float(np.mean(error <= HALF_WIDTH_50 * std))


def coverage90(error: np.ndarray, std: np.ndarray) -> float:
    """Fraction of the truths inside the central 90 %."""
    return float(np.mean(error <= HALF_WIDTH_90 * std))


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
