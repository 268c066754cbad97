"""`vsfsim inspect RESULT`: where a method errs, object by object and touch by touch, the worst first."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.board.compare import by_object
from vsfsim.bench.curves import Curves
from vsfsim.bench.leaderboard import score_table
from vsfsim.bench.metric_functions import object_of
from vsfsim.bench.metrics import METRICS
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task, load_task
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.scene import load_scene
from vsfsim.core.shape import probe_table
from vsfsim.core.text_table import text_table

MOST_LINES = 12
"""Touches in the text."""


@dataclass(frozen=True)
class _Touch:
    """A query touch, means over runs."""

    view: str
    touch: int
    error: Mapping[str, float]
    """Root mean square error by shot [unit]."""
    share: float
    """Error at the shot that sorts over what predicting zero errs on the object's touches [-]; NaN if that is not
    known."""
    gain: float
    """Factor of the truth that comes nearest to the prediction at that shot [-]; NaN without the predictions."""


def inspect_result(path: Path, *, shot: str = "") -> tuple[str, dict[str, Any]]:
    """Errors of a result file by object and by touch, the worst first; `vsfsim view RESULT` draws them.

    Args:
        path: of the result. shot: label at which errors are sorted; "" for the one that ranks.

    Returns:
        The text to print, and the same for JSON.

    Raises:
        TaskError: the file is not a result, its predictions are of another one, or it has no such shot.
    """
    result = Result.load(path)
    curves = Curves.beside(result, path)
    metric, ranking = _asked(result)
    shot = shot or ranking
    if shot not in result.shots:
        raise TaskError(f"--shot is '{shot}'. {did_you_mean(shot, result.shots)}")
    objects = {label: by_object(result, metric, label) for label in result.shots}
    touches = _touches(result, shot, curves)
    head = ["object", *(f"{label}-shot" for label in result.shots)]
    order = sorted(objects[shot], key=lambda name: objects[shot][name],
                   reverse=not METRICS[metric].higher_is_better)
    rows = [[name, *(f"{of[name]:.3f}" if name in of else "" for of in objects.values())] for name in order]
    sort = (f"touches with the largest errors at {shot}-shot, means over {len(result.seeds)} runs; share: of the mean "
            f"error of predicting zero on the object" + ("; gain: prediction over truth" if curves else ""))
    kinds = by_kind(result, load_task(result.task)) if result.task in shelf.tasks() else {}
    lines = [score_table(result, metric), "", f"{metric} by object, the worst first", text_table(head, rows), "", sort,
             text_table(*_touch_table(touches[:MOST_LINES], result.shots, result.unit))]
    if kinds:
        cells = [[name, *(f"{of[label]:.3f}" for label in result.shots)] for name, of in kinds.items()]
        lines += ["", "error over that of predicting zero, pooled over objects, by what presses",
                  text_table(["press", *head[1:]], cells)]
    lines += ["", f"vsfsim view {path}   # draws predictions over readings" if curves is not None else
              "The predictions were not kept: `vsfsim evaluate --keep predictions` makes the curves of the touches."]
    return "\n".join(lines), {
        "task": result.task, "method": result.method, "metric": metric, "shot": shot,
        "objects": objects, "presses": kinds,
        "touches": [{"view": t.view, "touch": t.touch, "rmse": dict(t.error), "share": t.share, "gain": t.gain}
                    for t in touches]}


def by_kind(result: Result, task: Task) -> dict[str, dict[str, float]]:
    """Of a task with ``transfer``, the root of the summed squared errors over that of predicting zero [-], by what
    presses and by shot; {} for other tasks."""
    if not task.protocol.transfer:
        return {}
    scene = load_scene(shelf.find_scene(task.dataset.scene)).sample(0)
    names = [json.dumps(probe_table(press.probe)) + (" from the side" if press.required_touches.level else "")
             for press in scene.presses]
    sums: dict[str, dict[str, np.ndarray]] = {}
    for row in result.rows():
        of = sums.setdefault(names[scene.required_touches.kind(row["touch"])], {})
        of[row["shot"]] = of.get(row["shot"], np.zeros(2)) + [row["sse"], row["ss"] or 0.0]
    return {name: {shot: math.sqrt(error / zero) if zero > 0.0 else math.nan for shot, (error, zero) in of.items()}
            for name, of in sorted(sums.items())}


def _asked(result: Result) -> tuple[str, str]:
    """The metric and the shot that rank; of a task that is not installed the ratio, or the error, at the last size."""
    try:
        task = load_task(result.task)
        if task.primary in result.scores and task.ranking_shot in result.shots:
            return task.primary, task.ranking_shot
    except TaskError:
        pass  # a task file of the user's
    return ("rmse_ratio" if "rmse_ratio" in result.scores else "rmse"), result.shots[-2 if len(result.shots) > 1 else 0]


def _touches(result: Result, shot: str, curves: Curves | None) -> list[_Touch]:
    errors: dict[tuple[str, int], dict[str, list[float]]] = {}
    zero: dict[str, dict[tuple[str, int], float]] = {}
    for row in result.rows():
        one = errors.setdefault((row["object"], row["touch"]), {})
        one.setdefault(row["shot"], []).append(math.sqrt(row["sse"] / row["n"]))
        if row["ss"] is not None:
            of_object = zero.setdefault(object_of(row["object"]), {})
            of_object[row["object"], row["touch"]] = math.sqrt(row["ss"] / row["n"])
    gains = _gains(curves, shot) if curves is not None else {}
    out = []
    for (view, touch), by_shot in errors.items():
        means = {label: math.fsum(v) / len(v) for label, v in by_shot.items()}
        known = list(zero.get(object_of(view), {}).values())
        level = math.fsum(known) / len(known) if known else 0.0
        out.append(_Touch(view, touch, means, means[shot] / level if level > 0.0 else math.nan,
                          gains.get((view, touch), math.nan)))
    return sorted(out, key=lambda t: -(t.share if math.isfinite(t.share) else t.error[shot]))


def _gains(curves: Curves, shot: str) -> dict[tuple[str, int], float]:
    mean = curves.predicted[curves.shots.index(shot)].mean(axis=0)
    out = {}
    for k, (view, touch) in enumerate(zip(curves.objects, curves.touches.tolist(), strict=True)):
        frames = slice(int(curves.start[k]), int(curves.start[k + 1]))
        truth = curves.truth[frames]
        size = float(np.nansum(truth**2))
        out[view, touch] = float(np.nansum(truth * mean[frames])) / size if size > 0.0 else math.nan
    return out


def _touch_table(touches: Sequence[_Touch], shots: Sequence[str], unit: str) -> tuple[list[str], list[list[str]]]:
    def number(value: float) -> str:
        return f"{value:.3f}" if math.isfinite(value) else ""

    head = ["object view", "touch", *(f"{label}-shot [{unit}]" for label in shots), "share", "gain"]
    return head, [[t.view, str(t.touch), *(number(t.error[label]) for label in shots), number(t.share), number(t.gain)]
                  for t in touches]
