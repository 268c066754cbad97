"""The ruler. Each score with its formula; y are noise-free readings, p predictions, both in the task's unit.

Only valid (converged) frames of query touches count. A reading of d numbers counts as d readings.

rmse         mean over query touches of sqrt(mean_t (p - y)^2)
rmse_pooled  sqrt(mean over all readings of all query touches of (p - y)^2)
mae          mean over query touches of mean_t |p - y|
mae_pooled   mean over all readings of all query touches of |p - y|

Stiffness, at the probed points that some touch of the object reached; s are a method's means, k the truth (the force of
a small cone over its displacement, SBML appendix C.4):

stiffness_spearman    rank correlation of s and k, ties sharing their mean rank; 0 if s is the same everywhere
stiffness_log10       mean |log10 s - log10 k - c|, with the one allowed scale c = median(log10 s - log10 k) over s > 0;
                      an s at or near 0 counts as a tenth of the softest k times that scale
stiffness_f1          how well the stiff points are told from the soft ones: k is cut in two where the classes of log10
k differ most (Otsu
                      1979), s at the threshold that is best for it (Neural VSF table I chooses one for each method,
                      too)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

READING_METRICS = ("rmse", "rmse_pooled", "mae", "mae_pooled")
STIFFNESS_METRICS = ("stiffness_spearman", "stiffness_log10", "stiffness_f1")


def touch_errors(prediction: np.ndarray, truth: np.ndarray, valid: np.ndarray) -> dict[str, float]:
    """Raw errors of one query touch, from which every reading metric can be computed.

    Args:
        prediction: (T, d). truth: noise-free readings (T, d). valid: (T,) bool, at least one True.

    Returns:
        ``n`` readings, ``sse`` sum of squares, ``sae`` sum of absolute values.
    """
    error = prediction[valid] - truth[valid]
    return {"n": int(error.size), "sse": float(np.sum(error**2)), "sae": float(np.sum(np.abs(error)))}


def reading_scores(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The reading metrics of a set of query touches, from their `touch_errors`."""
    n = np.array([row["n"] for row in rows], float)
    sse = np.array([row["sse"] for row in rows])
    sae = np.array([row["sae"] for row in rows])
    return {"rmse": float(np.mean(np.sqrt(sse / n))), "rmse_pooled": float(np.sqrt(sse.sum() / n.sum())),
            "mae": float(np.mean(sae / n)), "mae_pooled": float(sae.sum() / n.sum())}


def stiffness_scores(estimate: np.ndarray, truth: np.ndarray) -> dict[str, float] | None:
    """The stiffness metrics of one object, or None with fewer than 3 points or no positive estimate.

    Args:
        estimate: a method's means (k,), >= 0. truth: probe stiffness (k,) [N/m], > 0.
    """
    if len(truth) < 3 or not np.any(estimate > 0):
        return None
    scale = stiffness_scale(estimate, truth)
    floor = 0.1 * truth.min() * 10.0**scale
    error = np.abs(np.log10(np.maximum(estimate, floor)) - np.log10(truth) - scale)
    return {"stiffness_spearman": spearman(estimate, truth), "stiffness_log10": float(error.mean()),
            "stiffness_f1": best_f1(estimate, stiff_points(truth))}


def stiffness_scale(estimate: np.ndarray, truth: np.ndarray) -> float:
    """The one allowed scale c [decades]: the median of log10 s - log10 k over s > 0, of which there must be one."""
    positive = estimate > 0
    return float(np.median(np.log10(estimate[positive]) - np.log10(truth[positive])))


def stiff_points(truth: np.ndarray) -> np.ndarray:
    """Which of the stiffnesses ``truth`` (k,) > 0 belong to the stiff one of two classes (k,) bool; none if all are
    equal."""
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
    positive."""
    return best_threshold(estimate, positive)[0]


def best_threshold(estimate: np.ndarray, positive: np.ndarray) -> tuple[float, float]:
    """That score and its threshold; (0, inf) if nothing is positive."""
    order = np.argsort(-estimate, kind="stable")
    hit = np.cumsum(positive[order])
    last = np.append(np.diff(estimate[order]) != 0.0, True)  # points of one value fall on one side together
    if not positive.any():
        return 0.0, float("inf")
    scores = np.where(last, 2.0 * hit / (np.arange(1, len(hit) + 1) + positive.sum()), -1.0)
    best = int(np.argmax(scores))
    return float(scores[best]), float(estimate[order][best])


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's rank correlation of two arrays (k,); 0 where one of them is constant."""
    ra, rb = _ranks(a), _ranks(b)
    ra, rb = ra - ra.mean(), rb - rb.mean()
    norm = np.sqrt((ra @ ra) * (rb @ rb))
    return float(ra @ rb / norm) if norm > 0 else 0.0


def _ranks(values: np.ndarray) -> np.ndarray:
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    return (last - (counts - 1) / 2.0)[inverse]
