"""`vsfsim bench plants`: touches and readings a second of a plants dataset, stage by stage."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.records import ObjectView
from vsfsim.generate.plant_batches import crew, finish_one, prepare_one
from vsfsim.generate.plants import Seconds, Subject, solve
from vsfsim.generate.run import Job, jobs_of, make_recipe
from vsfsim.generate.touch import _BALANCE
from vsfsim.physics.rods.solver import RodFrames

PAPER_TOUCHES, PAPER_READINGS = 3255, 807_103  # SBML appendix B.1
PHASES = {"prepare": ("grow", "look", "aim"), "touch": ("kinematics", "solve"), "finish": ("torque", "truth")}
WHAT = {"grow": "the plant and its beams", "look": "RGB-D picture", "aim": "straight lines by inverse kinematics", "kinematics": "poses of the capsules",
        "solve": "equilibria of the plant", "torque": "J^T f and records", "truth": "stiffness of points, oracle VSF"}
PREPARE_SHARE, SOLVE_SHARE = 0.45, 0.85  # of the time that the bench may take: when views are no longer waited for, and when no launch is begun


def bench(*, device: str, scene: str, objects: int | None, views: int | None, touches: int | None, progress: Callable[[str], None], seconds: float | None = None,
          workers: int | None = None) -> dict[str, Any]:
    """Make the object views of a scene, all of them together, and say where the time went.

    Views are prepared and finished by ``workers`` processes; on a GPU the touches of all views are solved in one batch, on a CPU view by view in this process.

    Args:
        device: Warp device. scene: name or path. objects, views, touches: counts, None for the scene's. progress: called with what is going on.
        seconds: the bench ends about this long after the kernels are ready, and what was done by then is what is counted; None for no limit.
        workers: processes, None for one on a CPU and one a core on a GPU.

    Raises:
        VsfsimError: not one view was ready in time.
    """
    from vsfsim.generate.run import _kernels
    from vsfsim.physics.device import compile_kernels

    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=0, objects=objects, views=views, touches=touches, tier=None, device=device, precision="float64", renderer="warp")
    jobs = jobs_of(recipe, loaded.path, None, Path("."), None)
    began = time.perf_counter()
    progress("compiling kernels, or finding them")
    compile_kernels(_kernels("float64", loaded.sample(0)), device)
    compiling = time.perf_counter() - began
    progress(f"kernels ready after {compiling:.1f} s")
    count = workers or (1 if device == "cpu" else os.cpu_count() or 1)
    begin = time.perf_counter()

    def left(share: float) -> float | None:
        return None if seconds is None else max(0.0, share * seconds - (time.perf_counter() - begin))

    spent = Seconds()
    wall = dict.fromkeys(PHASES, 0.0)
    done = dict.fromkeys(PHASES, 0)
    with crew(len(jobs), count) as pool:
        since = time.perf_counter()
        subjects = _prepared(jobs, [pool.submit(prepare_one, job, device) for job in jobs], left(PREPARE_SHARE), spent, progress)
        if not subjects:
            raise VsfsimError(f"bench plants: no view was ready after {PREPARE_SHARE * (seconds or 0):.0f} s. Give it more --seconds, or fewer --touches a view.")
        wall["prepare"], done["prepare"] = time.perf_counter() - since, sum(len(a.q) for s in subjects for a in s.aims)
        since = time.perf_counter()
        found = _solved(subjects, device, left(SOLVE_SHARE), spent, progress, since)
        wall["touch"], done["touch"] = time.perf_counter() - since, int(sum(frames.frames.sum() for frames, _ in found))
        since = time.perf_counter()
        made = _finished(subjects, found, pool, device, left(1.0), spent, progress)
        wall["finish"], done["finish"] = time.perf_counter() - since, sum(len(t.time) for view in made for t in view.touches)
    return {"scene": loaded.name, "device": device, "machine": f"{platform.machine()}, {os.cpu_count()} CPU cores", "workers": count, "views": len(subjects), "views_asked": len(jobs),
            "segments": [len(s.plant.nodes) - 1 for s in subjects], **_audit(found), "compile_s": compiling, "wall_s": time.perf_counter() - begin, "phases_s": wall, "phases_readings": done,
            "stages_s": {name: spent.spent[name] for name in WHAT}, "stages_cpu_s": {name: spent.cpu[name] for name in WHAT}}


def _prepared(jobs: Sequence[Job], waiting: list[Future[tuple[Subject, Seconds]]], limit: float | None, spent: Seconds, progress: Callable[[str], None]) -> list[Subject]:
    """The views that are ready in time, the others called off."""
    until = None if limit is None else time.perf_counter() + limit
    open_: set[Future[tuple[Subject, Seconds]]] = set(waiting)
    while open_ and (until is None or time.perf_counter() < until):
        ready, open_ = wait(open_, timeout=2.0)
        for future in ready:
            future.result()
        if ready:
            progress(f"{len(waiting) - len(open_)} of {len(jobs)} views prepared")
    out = []
    for future in waiting:
        if future in open_:
            future.cancel()
            continue
        subject, took = future.result()
        _add(spent, took)
        out.append(subject)
    return out


def _solved(subjects: list[Subject], device: str, limit: float | None, spent: Seconds, progress: Callable[[str], None], since: float) -> list[tuple[RodFrames, slice]]:
    total, so_far = sum(len(a.q) for s in subjects for a in s.aims), [0]

    def count(frames: int, going: int) -> None:
        so_far[0] += frames
        took = time.perf_counter() - since
        progress(f"{so_far[0]} of at most {total} readings solved in {took:.1f} s: {so_far[0] / took:.0f} a second, {going} touches go on")

    return solve(subjects, device=device, progress=count, seconds=spent, limit=limit)


def _finished(subjects: list[Subject], found: list[tuple[RodFrames, slice]], pool: Any, device: str, limit: float | None, spent: Seconds, progress: Callable[[str], None]) -> list[ObjectView]:
    """The records of as many views as are ready in time."""
    waiting = [pool.submit(finish_one, subject, frames, columns, device) for subject, (frames, columns) in zip(subjects, found, strict=True)]
    ready, late = wait(waiting, timeout=limit)
    for future in late:
        future.cancel()
    out = []
    for future in waiting:
        if future in ready:
            view, took = future.result()
            _add(spent, took)
            out.append(view)
    progress(f"records and truth of {len(out)} views")
    return out


def _add(spent: Seconds, took: Seconds) -> None:
    spent.spent.update(took.spent)
    spent.cpu.update(took.cpu)


def _audit(found: list[tuple[RodFrames, slice]]) -> dict[str, Any]:
    parts = [frames for frames, _ in found]
    solved = [np.arange(f.residual.shape[0])[:, None] < f.frames[None] for f in parts]
    good = [f.converged & (f.force_balance <= _BALANCE) for f in parts]  # the others are marked in a dataset
    return {"touches": int(sum((f.frames > 0).sum() for f in parts)), "readings": int(sum(f.frames.sum() for f in parts)), "in_contact": int(sum((f.contacts > 0).sum() for f in parts)),
            "unconverged": int(sum((s & ~g).sum() for s, g in zip(solved, good, strict=True))),
            "largest_penetration": max(float(np.max(f.penetration[g], initial=0.0)) for f, g in zip(parts, good, strict=True)),
            "worst_balance": max(float(np.max(f.force_balance[g], initial=0.0)) for f, g in zip(parts, good, strict=True))}


def rates(found: dict[str, Any]) -> dict[str, float]:
    """Seconds for the papers' data set at the measured rates, phase by phase one after the other; "all", and "cpu": its processor time [s]."""
    out = {name: PAPER_READINGS * s / max(found["phases_readings"][name], 1) for name, s in found["phases_s"].items()}
    cpu = sum(PAPER_READINGS * found["stages_cpu_s"][stage] / max(found["phases_readings"][phase], 1) for phase, stages in PHASES.items() for stage in stages)
    return {**out, "all": sum(out.values()), "cpu": cpu}


def table(found: dict[str, Any]) -> str:
    """The result for the terminal."""
    n, done, paper = max(found["readings"], 1), found["phases_readings"], rates(found)
    cut = "" if found["views"] == found["views_asked"] else f" (of {found['views_asked']} asked for: the time was up)"
    lines = [f"{found['scene']} on {found['device']} ({found['machine']}), {found['workers']} processes: {found['views']} views{cut} of plants with {min(found['segments'])} to "
             f"{max(found['segments'])} segments, {found['touches']} touches, {found['readings']} readings",
             f"{found['in_contact']} readings in contact, {found['unconverged']} ({100 * found['unconverged'] / n:.2f} %) not converged and marked; deepest penetration {1e3 * found['largest_penetration']:.2g} mm, "
             f"worst force balance {found['worst_balance']:.1e}", "",
             f"{'stage':<12}{'readings':>10}{'s':>9}{'CPU s':>9}{'CPU ms a reading':>18}   what; seconds of all processes together"]
    for phase, stages in PHASES.items():
        for name in stages:
            s, busy = found["stages_s"][name], found["stages_cpu_s"][name]
            lines.append(f"{name:<12}{done[phase]:>10}{s:>9.2f}{busy:>9.2f}{1e3 * busy / max(done[phase], 1):>18.3f}   {WHAT[name]}")
    lines.append("")
    for phase, stages in PHASES.items():
        s = found["phases_s"][phase]
        lines.append(f"{phase:<8} {s:>8.2f} s on the clock, {done[phase] / max(s, 1e-9):>8.0f} readings a second, the papers' {PAPER_READINGS} in {paper[phase] / 60:.1f} min   ({', '.join(stages)})")
    each = found["readings"] / max(found["touches"], 1)
    lines += ["", f"kernels were compiled or found before, in {found['compile_s']:.1f} s; the rest took {found['wall_s']:.1f} s: {n / found['wall_s']:.0f} readings a second, {n / found['wall_s'] / max(each, 1e-9):.2f} touches a second",
              f"the papers' data set ({PAPER_TOUCHES} touches, {PAPER_READINGS} readings), the phases one after the other at these rates: {paper['all'] / 60:.0f} min on the clock, "
              f"{paper['cpu'] / 60:.0f} min of CPU time"]
    return "\n".join(lines)
