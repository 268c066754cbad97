"""`vsfsim show RESULT`: where a method errs, object by object and touch by touch, the worst first."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from vsfsim.bench.board.compare import by_object
from vsfsim.bench.board.templates import filled
from vsfsim.bench.metrics import METRICS, object_of
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.core.errors import TaskError

MOST_LINES = 12
"""Touches in the text."""


def inspect_result(path: Path) -> tuple[str, dict[str, Any]]:
    """Errors of a result file by object and by touch, the worst first at the shot that ranks; `vsfsim show RESULT --out
    page.html` draws them.

    Returns:
        The text to print, and the same for JSON.

    Raises:
        TaskError: the file is not a result.
    """
    result = Result.load(path)
    metric, shot = _asked(result)
    objects = {label: by_object(result, metric, label) for label in result.shots}
    touches = _touches(result, shot)
    order = sorted(objects[shot], key=lambda name: objects[shot][name], reverse=not METRICS[metric].higher_is_better)
    page = filled("inspect.txt", scores=result.table(metric), result=result, metric=metric, shot=shot,
                  head=["object", *(f"{label}-shot" for label in result.shots)],
                  objects=[[name, *(_written(of.get(name)) for of in objects.values())] for name in order],
                  units=[f"{label}-shot [{result.unit}]" for label in result.shots],
                  touches=[[t["view"], str(t["touch"]), *(_written(t["rmse"][label]) for label in result.shots),
                            _written(t["share"])] for t in touches[:MOST_LINES]], path=str(path))
    return page, {"task": result.task, "method": result.method, "metric": metric, "shot": shot, "objects": objects,
                  "touches": touches}


def _written(value: float | None) -> str:
    return f"{value:.3f}" if value is not None and math.isfinite(value) else ""


def _asked(result: Result) -> tuple[str, str]:
    """The metric and the shot that rank; of a task that is not installed the ratio, or the error, at the last size."""
    try:
        task = load_task(result.task)
        if task.primary in result.scores and task.ranking_shot in result.shots:
            return task.primary, task.ranking_shot
    except TaskError:
        pass  # a task file of the user's
    return ("rmse_ratio" if "rmse_ratio" in result.scores else "rmse"), result.shots[-2 if len(result.shots) > 1 else 0]


def _touches(result: Result, shot: str) -> list[dict[str, Any]]:
    """The query touches, means over runs, the worst first: the root mean square error by shot [unit]; and the share of
    it at ``shot`` of what predicting zero errs on the object's touches [-], NaN where it is not known."""
    errors: dict[tuple[str, int], dict[str, list[float]]] = {}
    zero: dict[str, dict[tuple[str, int], float]] = {}
    for row in result.rows:
        key = row["object"], row["touch"]
        errors.setdefault(key, {}).setdefault(row["shot"], []).append(math.sqrt(row["sse"] / row["n"]))
        if row["ss"] is not None:
            zero.setdefault(object_of(row["object"]), {})[key] = math.sqrt(row["ss"] / row["n"])
    out = []
    for (view, touch), by_shot in errors.items():
        means = {label: math.fsum(v) / len(v) for label, v in by_shot.items()}
        known = list(zero.get(object_of(view), {}).values())
        level = math.fsum(known) / len(known) if known else 0.0
        out.append({"view": view, "touch": touch, "rmse": means,
                    "share": means[shot] / level if level > 0.0 else math.nan})
    return sorted(out, key=lambda t: -(t["share"] if math.isfinite(t["share"]) else t["rmse"][shot]))
