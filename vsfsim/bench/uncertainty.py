"""How well a method knows what it does not know. Scored where it gives a standard deviation; e is its error, s its std.

nll          mean of 1/2 (e / s)^2 + log s + 1/2 log 2 pi: lower is better, and both false confidence and false modesty
cost coverage50   share of truths within 0.674 s of the mean: 0.5 is right
coverage90   share of truths within 1.645 s: 0.9 is right

Of readings (optional `predict_std`): e against the noise-free reading, over all readings of all query touches.
Of stiffness, prefix `stiffness_`: at the reached probe points, after the one allowed scale c of `stiffness_log10` on
mean and std; and

stiffness_std_spearman  rank correlation of |e| and s: is it least sure where it errs most?

A std under a thousandth of the median truth (of stiffness) or 1e-6 of the unit (of readings) counts as that: certainty
is finite.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.bench.metrics import spearman, stiffness_scale

READING_UNCERTAINTY = ("nll", "coverage50", "coverage90")
STIFFNESS_UNCERTAINTY = ("stiffness_nll", "stiffness_coverage50", "stiffness_coverage90", "stiffness_std_spearman")
# Half-widths of the central 50 % and 90 % of a normal distribution, in standard deviations.
_HALF, _MOST = 0.6744897501960817, 1.6448536269514722


def touch_uncertainty(prediction: np.ndarray, std: np.ndarray, truth: np.ndarray,
                      valid: np.ndarray) -> dict[str, float]:
    """Sums of one query touch, from which `reading_uncertainty` is made.

    Args:
        prediction, std, truth: (T, d). valid: (T,) bool, at least one True.
    """
    error, s = np.abs(prediction - truth)[valid], np.maximum(std[valid], 1e-6)
    return {"n": int(error.size), "nll": float(np.sum(_nll(error, s))), "in50": int(np.sum(error <= _HALF * s)),
            "in90": int(np.sum(error <= _MOST * s))}


def reading_uncertainty(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """The metrics of a set of query touches, from their `touch_uncertainty`."""
    n = sum(row["n"] for row in rows)
    return dict(zip(READING_UNCERTAINTY, (sum(row[key] for row in rows) / n for key in ("nll", "in50", "in90"))))


def stiffness_uncertainty(mean: np.ndarray, std: np.ndarray, truth: np.ndarray) -> dict[str, float] | None:
    """The metrics of one object; None with fewer than 3 points, no positive mean, or a method that gives no std (all
    0).

    Args:
        mean, std: a method's (k,), >= 0. truth: probe stiffness (k,) [N/m], > 0.
    """
    if len(truth) < 3 or not np.any(mean > 0) or not np.any(std > 0):
        return None
    scale = 10.0 ** -stiffness_scale(mean, truth)
    error, s = np.abs(scale * mean - truth), np.maximum(scale * std, 1e-3 * float(np.median(truth)))
    return dict(zip(STIFFNESS_UNCERTAINTY, (float(np.mean(_nll(error, s))), float(np.mean(error <= _HALF * s)),
                                            float(np.mean(error <= _MOST * s)), spearman(error, s))))


def _nll(error: np.ndarray, std: np.ndarray) -> np.ndarray:
    return 0.5 * (error / std) ** 2 + np.log(std) + 0.5 * np.log(2.0 * np.pi)
