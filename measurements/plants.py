"""Touches and readings a second of a plants dataset, the whole and stage by stage: `vsfsim measure plants`."""

from __future__ import annotations

import os
import time
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.records import ObjectView
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.batches import finish_one, touched
from vsfsim.generate.plants.prepare import Seconds
from vsfsim.generate.plants.touches import rod_options
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.record import BALANCE
from vsfsim.generate.workers import process_pool
from vsfsim.physics.rods.solver import Ended, RodFrames

PAPER_TOUCHES, PAPER_READINGS = 3255, 807_103  # SBML appendix B.1
WHAT = {"grow": "the plant and its beams", "look": "RGB-D picture", "aim": "straight lines by inverse kinematics",
        "kinematics": "poses of the capsules", "solve": "equilibria of the plant", "torque": "J^T f and records",
        "truth": "stiffness of points, oracle VSF"}
"""What each stage does."""
_SOLVE_SHARE = 0.9  # share of the time limit after which no launch begins


def measure(*, device: str = "cpu", scene: str = "plants", objects: int | None = None, views: int | None = None,
            touches: int | None = None, seconds: float | None = None, workers: int | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Make the object views of a scene as `vsfsim generate` does on a GPU, without writing files, and measure the time
    of each stage.

    Worker processes prepare and finish views; this process solves the views that are ready, together.

    Args:
        device: Warp device.
        scene: name or path.
        objects, views, touches: counts; None for 3, 1 and 6 on a CPU and the scene's on a GPU.
        seconds: time limit, counted from when the kernels are ready [s]; what is done by then counts. None for none.
        workers: processes; None for one on a CPU and one a core on a GPU.
        progress: called with what is going on.

    Raises:
        VsfsimError: not one view was ready in time.
    """
    from vsfsim.generate.run import kernels_of
    from vsfsim.physics.runtime import compile_kernels

    if device == "cpu":
        objects, views, touches = objects or 3, views or 1, touches or 6
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, objects=objects, views=views, touches=touches, device=device)
    jobs = jobs_of(recipe, loaded.path, Path("."), None)
    began = time.perf_counter()
    progress("compiling kernels, or finding them")
    compile_kernels(kernels_of(loaded.sample(0)), device)
    compiling = time.perf_counter() - began
    progress(f"kernels ready after {compiling:.1f} s")
    count = workers or (1 if device == "cpu" else os.cpu_count() or 1)
    start = time.perf_counter()
    spent, solved, prepared = Seconds(), [0], [0]
    clock = {"first touches ready": 0.0, "all touches ready": 0.0, "all touches solved": 0.0, "all records made": 0.0}

    def watch(what: str, new: int, going: int) -> None:
        now = time.perf_counter() - start
        if what == "prepared":
            prepared[0] += new
            clock["first touches ready"] = clock["first touches ready"] or now
            clock["all touches ready"] = now
        else:
            solved[0] += new
        progress(f"{now:.1f} s: {prepared[0]} of {recipe.touches * len(jobs)} touches ready, {solved[0]} readings "
                 f"solved, {going} touches go on")

    found: list[RodFrames] = []
    segments: list[int] = []
    planned = 0
    with process_pool(len(jobs), count, device=device) as pool:
        waiting: list[Future[tuple[ObjectView, Seconds]]] = []
        for _, subject, frames in touched(jobs, pool, device=device, spent=spent,
                                          until=None if seconds is None else start + _SOLVE_SHARE * seconds,
                                          watch=watch):
            found.append(frames)
            segments.append(len(subject.plant.nodes) - 1)
            planned += sum(len(a.plan) for a in subject.aims)
            waiting.append(pool.submit(finish_one, subject, frames, device))
        if not found:
            raise VsfsimError(f"measure plants: no view was ready after {_SOLVE_SHARE * (seconds or 0):.0f} s. Give it "
                              f"more --seconds, or fewer --touches a view.")
        clock["all touches solved"] = time.perf_counter() - start
        made = _finished(waiting, None if seconds is None else max(0.0, seconds - (time.perf_counter() - start)), spent)
        clock["all records made"] = time.perf_counter() - start
        progress(f"{clock['all records made']:.1f} s: records and truth of {len(made)} views")
    numbers = {"scene": loaded.name, "device": device, "workers": count, "views": len(found), "views_asked": len(jobs),
               "segments": segments, **_audit(found, rod_options(loaded.sample(0)).patience),
               "readings_planned": planned, "touches_asked": recipe.touches * len(jobs), "views_made": len(made),
               "records": sum(len(t.time) for view in made for t in view.touches), "compile_s": compiling,
               "wall_s": clock["all records made"], "clock_s": clock,
               "stages_s": {name: spent.spent[name] for name in WHAT},
               "stages_cpu_s": {name: spent.cpu[name] for name in WHAT}}
    return report({"device": device, "scene": scene, "objects": recipe.objects, "views": recipe.views,
                   "touches": recipe.touches, "seconds": seconds, "workers": count}, numbers)


def _finished(waiting: list[Future[tuple[ObjectView, Seconds]]], limit: float | None,
              spent: Seconds) -> list[ObjectView]:
    """The records of as many views as are ready in time."""
    ready, late = wait(waiting, timeout=limit)
    for future in late:
        future.cancel()
    out = []
    for future in waiting:
        if future in ready:
            view, took = future.result()
            spent.add(took)
            out.append(view)
    return out


def _audit(found: list[RodFrames], patience: int | None) -> dict[str, Any]:
    solved = [np.arange(f.residual.shape[0])[:, None] < f.frames[None] for f in found]
    good = [f.converged & (f.force_balance <= BALANCE) for f in found]  # the others are marked in a dataset
    cut = sum(((f.frames < f.residual.shape[0]) & (f.ended == Ended.WHOLE)).sum() for f in found)
    return {"touches": int(sum((f.frames > 0).sum() for f in found)),
            "empty": int(sum((f.frames == 0).sum() for f in found)), "cut": int(cut),
            "stopped": int(sum((f.ended == Ended.FORCE).sum() for f in found)),
            "readings": int(sum(f.frames.sum() for f in found)),
            "in_contact": int(sum((f.contacts > 0).sum() for f in found)),
            "unconverged": int(sum((s & ~g).sum() for s, g in zip(solved, good, strict=True))), "patience": patience,
            "given_up": int(sum((f.ended == Ended.PATIENCE).sum() for f in found)),
            "most_iterations": int(max(f.iterations.sum(axis=0).max() for f in found)),
            "mean_iterations": float(np.mean(np.concatenate([f.iterations.sum(axis=0) for f in found]))),
            "largest_penetration": max(float(np.max(f.penetration[g], initial=0.0)) for f,
                                       g in zip(found, good, strict=True)),
            "worst_balance": max(float(np.max(f.force_balance[g], initial=0.0)) for f,
                                 g in zip(found, good, strict=True))}


def whole(found: dict[str, Any]) -> bool:
    """Whether everything that was asked for is done: all touches to their ends, all their records."""
    # a record may have fewer readings than were solved: what is not in equilibrium before the force limit is left out
    # of a touch that ends there
    return (found["touches"] + found["empty"] == found["touches_asked"] and found["cut"] == 0
            and found["views_made"] == found["views_asked"])


def paper_seconds(found: dict[str, Any]) -> tuple[float, float]:
    """Seconds for the papers' readings at the rate of the whole, on the clock and of processor time."""
    n = max(min(found["readings"], found["records"]), 1)
    return PAPER_READINGS * found["wall_s"] / n, PAPER_READINGS * sum(found["stages_cpu_s"].values()) / n


def report(settings: dict[str, Any], found: dict[str, Any]) -> Measurement:
    """The numbers of `measure`, and what follows from them, as a measurement."""
    n, wall, (clock, cpu) = max(found["readings"], 1), found["wall_s"], paper_seconds(found)
    rates = {"readings_per_s": n / wall, "touches_per_s": found["touches"] / wall, "paper_clock_s": clock,
             "paper_cpu_s": cpu, "unconverged_share": found["unconverged"] / n}
    notes = [] if whole(found) else [
        f"NOT ALL was done in time: {found['touches_asked']} touches of {found['views_asked']} views were asked for, "
        f"{found['cut']} were cut, records were made of {found['views_made']} views."]
    if found["patience"] is not None:
        notes.append(f"A touch ends after {found['patience']} Newton iterations.")
    notes.append(f"The papers' data set has {PAPER_TOUCHES} touches and {PAPER_READINGS} readings; its times are "
                 f"extrapolated from the rates.")
    stages = [{"stage": name, "what": what, "clock": found["stages_s"][name], "cpu": found["stages_cpu_s"][name],
               "each": found["stages_cpu_s"][name] / n} for name, what in WHAT.items()]
    return Measurement.of("plants", settings, [
        Table(f"plants of {found['scene']}, {min(found['segments'])} to {max(found['segments'])} segments", (
            Column("views", "views", "1"), Column("touches", "touches", "1"), Column("readings", "readings", "1"),
            Column("readings_planned", "readings planned", "1"), Column("in_contact", "readings in contact", "1"),
            Column("unconverged_share", "readings not converged, marked", "1", "%", ".2f"),
            Column("stopped", "touches ended by the arm's protective stop", "1"),
            Column("given_up", "touches ended by their iterations", "1"),
            Column("mean_iterations", "Newton iterations a touch, mean", "1", form=".0f"),
            Column("most_iterations", "Newton iterations a touch, most", "1"),
            Column("largest_penetration", "deepest penetration", "m", "mm", ".2g"),
            Column("worst_balance", "worst force balance", "1", form=".1e"),
            Column("compile_s", "kernels compiled or found, before", "s", form=".1f"),
            *(Column(f"clock_s.{name}", f"{name}, after", "s", form=".1f") for name in found["clock_s"]),
            Column("touches_per_s", "touches a second", "1/s", form=".2f"),
            Column("readings_per_s", "readings a second", "1/s", form=".0f"),
            Column("paper_clock_s", "the papers' data set, on the clock", "s", "min", ".1f"),
            Column("paper_cpu_s", "the papers' data set, CPU time", "s", "min", ".0f")), [{**found, **rates}],
            single=True),
        Table("stages, all processes together", (
            Column("stage", "stage"), Column("clock", "time", "s", form=".2f"),
            Column("cpu", "CPU time", "s", form=".2f"), Column("each", "CPU a reading", "s", "ms", ".3f"),
            Column("what", "what")), stages)],
        notes=notes, numbers={**found, **rates})
