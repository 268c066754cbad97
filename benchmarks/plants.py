"""`vsfsim measure plants`: touches and readings a second of a plants dataset, the whole and stage by stage."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

import numpy as np

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
        "kinematics": "poses of the capsules",
        "solve": "equilibria of the plant", "torque": "J^T f and records", "truth": "stiffness of points, oracle VSF"}
SOLVE_SHARE = 0.9  # of the time that the bench may take: when no launch is begun any more


def bench(*, device: str, scene: str, objects: int | None, views: int | None, touches: int | None,
          progress: Callable[[str], None], seconds: float | None = None,
          workers: int | None = None) -> dict[str, Any]:
    """Make the object views of a scene as `vsfsim generate` does on a GPU, but for the files, and say where the time
    went.

    Views are prepared and finished by ``workers`` processes; this one solves those that are ready, together.

    Args:
        device: Warp device. scene: name or path. objects, views, touches: counts, None for the scene's. progress:
        called with what is going on.
        seconds: the bench ends about this long after the kernels are ready, and what was done by then is what is
        counted; None for no limit.
        workers: processes, None for one on a CPU and one a core on a GPU.

    Raises:
        VsfsimError: not one view was ready in time.
    """
    from vsfsim.generate.run import kernels_of
    from vsfsim.physics.runtime import compile_kernels

    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=0, objects=objects, views=views, touches=touches, tier=None, device=device,
                         precision="float64", renderer="warp")
    jobs = jobs_of(recipe, loaded.path, Path("."), None)
    began = time.perf_counter()
    progress("compiling kernels, or finding them")
    compile_kernels(kernels_of(loaded.sample(0), "float64"), device)
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
    with process_pool(len(jobs), count) as pool:
        waiting: list[Future[tuple[ObjectView, Seconds]]] = []
        for _, subject, frames in touched(jobs, pool, device=device, spent=spent,
                                          until=None if seconds is None else start + SOLVE_SHARE * seconds,
                                          watch=watch):
            found.append(frames)
            segments.append(len(subject.plant.nodes) - 1)
            planned += sum(len(a.plan) for a in subject.aims)
            waiting.append(pool.submit(finish_one, subject, frames, device))
        if not found:
            raise VsfsimError(f"bench plants: no view was ready after {SOLVE_SHARE * (seconds or 0):.0f} s. Give it "
                              f"more --seconds, or fewer --touches a view.")
        clock["all touches solved"] = time.perf_counter() - start
        made = _finished(waiting, None if seconds is None else max(0.0, seconds - (time.perf_counter() - start)), spent)
        clock["all records made"] = time.perf_counter() - start
        progress(f"{clock['all records made']:.1f} s: records and truth of {len(made)} views")
    return {"scene": loaded.name, "device": device, "machine": f"{platform.machine()}, {os.cpu_count()} CPU cores",
            "workers": count, "views": len(found), "views_asked": len(jobs), "segments": segments,
            **_audit(found, rod_options(loaded.sample(0)).patience), "readings_planned": planned,
            "touches_asked": recipe.touches * len(jobs), "views_made": len(made),
            "records": sum(len(t.time) for view in made for t in view.touches), "compile_s": compiling,
            "wall_s": clock["all records made"], "clock_s": clock,
            "stages_s": {name: spent.spent[name] for name in WHAT},
            "stages_cpu_s": {name: spent.cpu[name] for name in WHAT}}


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


def table(found: dict[str, Any]) -> str:
    """The result for the terminal."""
    n, wall, (clock, cpu) = max(found["readings"], 1), found["wall_s"], paper_seconds(found)
    ended = ("" if found["patience"] is None
             else f", {found['given_up']} touches ended after {found['patience']}; {found['stopped']} at the arm's "
                  f"protective stop")
    cut = ("" if whole(found) else f" (NOT ALL: {found['touches_asked']} touches of {found['views_asked']} views were "
                                   f"asked for, {found['cut']} were cut, records were made of {found['views_made']} "
                                   f"views; the time was up)")
    lines = [f"{found['scene']} on {found['device']} ({found['machine']}), {found['workers']} processes: "
             f"{found['views']} views{cut} of plants with {min(found['segments'])} to "
             f"{max(found['segments'])} segments, {found['touches']} touches, {found['readings']} of "
             f"{found['readings_planned']} readings",
             f"{found['in_contact']} readings in contact, {found['unconverged']} ({100 * found['unconverged'] / n:.2f} "
             f"%) not converged and marked; deepest penetration {1e3 * found['largest_penetration']:.2g} mm, "
             f"worst force balance {found['worst_balance']:.1e}; {found['mean_iterations']:.0f} Newton iterations a "
             f"touch on average, {found['most_iterations']} the most{ended}", "",
             f"{'stage':<12}{'s':>9}{'CPU s':>9}{'CPU ms a reading':>18}   what; seconds of all processes together"]
    for name, what in WHAT.items():
        s, busy = found["stages_s"][name], found["stages_cpu_s"][name]
        lines.append(f"{name:<12}{s:>9.2f}{busy:>9.2f}{1e3 * busy / n:>18.3f}   {what}")
    lines += ["", "after  " + ", ".join(f"{s:.1f} s {name}" for name, s in found["clock_s"].items()),
              f"kernels were compiled or found before, in {found['compile_s']:.1f} s; the whole, preparation included, "
              f"took {wall:.1f} s: {n / wall:.0f} readings a second, {found['touches'] / wall:.2f} touches a second",
              f"the papers' data set ({PAPER_TOUCHES} touches, {PAPER_READINGS} readings) at this rate: "
              f"{clock / 60:.1f} min on the clock, {cpu / 60:.0f} min of CPU time, {cpu / 120:.0f} min on two cores"]
    return "\n".join(lines)
