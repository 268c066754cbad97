"""Errors of predicted readings, and of the standard deviations given with them.

y are noise-free readings, p predictions, s their standard deviations, all in the task's unit. Only valid (converged)
frames of query touches count, and a reading of d numbers counts as d readings. A query touch is reduced to sums first
(`touch_errors`, `touch_uncertainty`); a metric is a function of the sums of several touches. The result file keeps the
sums of `touch_errors`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

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
