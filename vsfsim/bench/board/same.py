"""Whether two results are one: equal rows, rows of one dataset on machines that round otherwise, and rows that cannot
both be of one method."""

from __future__ import annotations

import math
from collections.abc import Mapping

from vsfsim.bench.board.compare import ByObject, paired
from vsfsim.bench.metrics import Answer, metrics_of
from vsfsim.bench.result import Result, readings_apart
from vsfsim.bench.task import Task

SAME_READINGS = 1e-3
"""Datasets whose readings differ by less, by `result.readings_apart`, count as the same dataset made on a machine with
other rounding: an error changes by about that fraction of the readings at most. Rounding alone gives 1e-8 where a touch
has a unique equilibrium; other seeds, scenes or physics differ by tens of per cent."""
_ROUNDING = 1e-8  # of the nine digits of a score that ships
_SAME_SCORE = 1e-4
"""Relative difference below which two scores on such datasets count as one result."""
_OTHER_SCORE = 0.02
"""The same, above which one method on one task cannot have given both."""


def over_objects(task: Task) -> bool:
    """Whether methods are compared object by object."""
    return bool(task.protocol.folds)


def far_apart(result: Result, known: Mapping[str, list]) -> str:
    """Why a result on other bits is not ranked where the task has no record, or ""."""
    apart = readings_apart(result.readings, known)
    if apart is not None and apart < SAME_READINGS:
        return ""
    difference = "" if apart is None else f", its readings are {100.0 * apart:.2g} % off"
    return f"other dataset ({result.dataset_sha256[:12]}{difference})"


def is_same(result: Result, before: Result) -> bool:
    """Whether two results are the same one. One of them may be from a machine with other rounding; the scores
    decide."""
    if any(getattr(result, key) != getattr(before, key) for key in ("method", "preset", "task_sha256", "parameters")):
        return False
    if result.dataset_sha256 == before.dataset_sha256:
        return _same_scores(result, before, list(result.scores), _ROUNDING)
    apart = readings_apart(result.readings, before.readings)
    if apart is None or not apart < SAME_READINGS or result.scores.keys() != before.scores.keys():
        return False
    names = [metric.name for metric in metrics_of(Answer.READINGS) if metric.name in result.scores]
    return _same_scores(result, before, names, _SAME_SCORE)


def _same_scores(one: Result, other: Result, names: list[str], tolerance: float) -> bool:
    """Whether the means and deviations of some metrics are the same at all shots. A row that ships has no others."""
    if any(one.scores[name].keys() != other.scores.get(name, {}).keys() for name in names):
        return False
    pairs = [pair for name in names for shot, score in one.scores[name].items()
             for pair in zip((score.mean, *score.per_seed), (
                 other.scores[name][shot].mean, *other.scores[name][shot].per_seed), strict=False)]
    return all(math.isclose(a, b, rel_tol=tolerance) for a, b in pairs)


def contradicts(one: Result, other: Result, task: Task, objects: tuple[ByObject, ByObject]) -> bool:
    """Whether two results of one method with the same settings on one task have scores that it cannot give both.

    Args:
        one, other: the results. task: of both. objects: the values of both by object, {} where the task has none.
    """
    keys = ("method", "preset", "parameters", "task_sha256")
    if any(getattr(one, key) != getattr(other, key) for key in keys):
        return False
    mine, theirs = (r.scores[task.primary][task.ranking_shot].mean for r in (one, other))
    return not math.isclose(mine, theirs, rel_tol=_OTHER_SCORE) and (
        not over_objects(task) or paired(*objects).told_apart)
