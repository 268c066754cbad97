"""`vsfsim measure promise SCENE`: whether touches under `vsfsim generate --accuracy` keep what was asked, and what that
costs beside one setting for all of them. Touches and their references serve every goal, so that they are made once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from measurements.tradeoff.front import READINGS
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import find_scene
from vsfsim.data.disk import Store
from vsfsim.data.manifest import ENOUGH, least_share, verdict
from vsfsim.generate.trade.buy import LEAST, MOST, PILOT, SEED, Tried, ended, ground_of, least_factor, touches
from vsfsim.generate.trade.setting import ROUGH

SCENES = ("foam-block", *(str(Path(__file__).parent / "touched" / f"{name}.toml") for name in ("block", "column")),
          "shoes-v3-mini", str(Path(__file__).parent / "touched" / "bubble-block.toml"))
GOALS = (0.05, 0.02, 0.01)


def measure(scenes: Sequence[str] = SCENES, count: int = 61, *, goals: Sequence[float] = GOALS, out: Path,
            workers: int | None = None, progress: Progress = lambda _: None) -> Measurement:
    """Of each scene a pilot and ``count`` touches of further objects, each under all settings and with a reference.

    What lies in the folder ``out`` is not made again. A pilot ends with the first touch that no goal allows.

    Raises:
        VsfsimError: no such scene, a goal that no touch could keep, or ``out`` cannot be written.
    """
    rows = []
    for goal in goals:
        if not LEAST <= goal <= MOST:
            raise VsfsimError(f"--goal is {goal:g}; an accuracy is {LEAST:g} to {MOST:g}, e.g. 0.05.")
    for name in scenes:
        loaded = load_scene(find_scene(name))
        ground, _ = ground_of(loaded, device="cpu")
        request = Request(seed=SEED, objects=PILOT + count, workers=workers)
        for some in filter(None, ([g for g in goals if g >= ROUGH], [g for g in goals if g < ROUGH])):
            found, folder = dict[int, Tried](), out / loaded.name / ("rough" if some[0] >= ROUGH else "fine")
            for number, touch in touches(loaded, ground, some[0], request, Store(folder)):
                found[number] = touch
                progress(f"{folder.relative_to(out)}: {len(found)} of {PILOT + count} touches")
                if number < PILOT and touch.errors[-1] > max(some):
                    break  # all of these goals are refused
            # in order, as they come the cheap ones are first
            pilot, data = ([found[k] for k in sorted(found) if (k < PILOT) is first] for first in (True, False))
            rows += [row_of(loaded.name, goal, [s.key for s in ground.steps()], pilot, data,
                            sum(loaded.sample(0).required_touches.frames)) for goal in some]
    return found_of(rows, {"touches": count})


def row_of(scene: str, goal: float, steps: Sequence[str], pilot: Sequence[Tried], data: Sequence[Tried],
           frames: int) -> dict[str, Any]:
    """What a goal [-] gives with the factor of a pilot: the share of other touches that are kept, and the processor
    time of a touch, which ``frames`` readings share, over that of the cheapest setting under which as many are."""
    factor = max(least_factor(touch.differences, touch.errors[1:], goal) for touch in pilot)
    if not np.isfinite(factor):
        off, worst = sum(touch.errors[-1] > goal for touch in pilot), max(touch.errors[-1] for touch in pilot)
        return {"scene": scene, "goal": goal, "single": "", "said":
                f"refused: {off} of {len(pilot)} touches of the pilot are off by more under {steps[-1]}"
                + (f", by up to {100 * worst:.2g} %" if np.isfinite(worst) else ", or lose a frame")}
    errors, seconds = (np.array([getattr(touch, name) for touch in data]) for name in ("errors", "seconds"))
    able = [k for k in range(len(steps)) if (errors[:, k] <= goal).mean() >= ENOUGH]
    single = min(able, key=lambda k: seconds[:, k].mean(), default=None)
    ends = [ended(touch.differences, factor, goal) for touch in data]
    kept = int(sum(errors[n, k + 1] <= goal for n, k in enumerate(ends)))
    cost = np.mean([seconds[n, :k + 2].sum() for n, k in enumerate(ends)])
    found = {"asked": goal, "observed": {"audits": len(data), "kept": kept}}
    return {"scene": scene, "goal": goal, "audits": len(data), "single": "none" if single is None else steps[single],
            "factor": factor, "kept": kept / len(data), "least": least_share(kept, len(data)), "cost": cost,
            "over": None if single is None else cost / seconds[:, single].mean(),
            "pilot": sum(sum(touch.seconds) for touch in pilot) / (cost * READINGS / frames),
            "said": verdict(found)[0].partition(":")[0]}


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    columns = (Column("scene", "scene"), Column("said", "verdict"), Column("single", "cheapest single setting"),
               Column("goal", "goal", "1", "%", "g"), Column("audits", "touches audited", "1"),
               Column("kept", "kept", "1", "%", ".0f"), Column("least", "at least", "1", "%", ".0f"),
               Column("factor", "factor", "1", form=".2g"), Column("cost", "CPU a touch", "s", form=".2g"),
               Column("over", "over the single setting", "1", form=".2g"),
               Column("pilot", f"pilot over {READINGS:,} readings", "1", "%", ".2g"))
    return Measurement.of("promise", settings, [Table(
        "Touches of as many objects, each audited, under the factor of a pilot of other objects", columns, rows,
        name="promise")])
