"""`vsfsim bench plants`: touches and readings a second of a plants dataset, stage by stage."""

from __future__ import annotations

import os
import platform
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.plants import Seconds, prepare_job, touch
from vsfsim.generate.run import Job, jobs_of, make_recipe

PAPER_TOUCHES, PAPER_READINGS = 3255, 807_103  # SBML appendix B.1
STAGES = ("grow", "look", "aim", "kinematics", "solve", "torque", "truth")
WHAT = {"grow": "the plant and its beams", "look": "RGB-D picture", "aim": "straight lines by inverse kinematics", "kinematics": "poses of the capsules",
        "solve": "equilibria of the plant", "torque": "J^T f and records", "truth": "stiffness of points, oracle VSF"}


def bench(*, device: str, scene: str, objects: int | None, views: int | None, touches: int | None, progress: Callable[[str], None]) -> dict[str, Any]:
    """Make the object views of a scene, several at a time on a GPU, and say where the time went.

    Args:
        device: Warp device. scene: name or path. objects, views, touches: counts, None for the scene's. progress: called with what is going on.
    """
    from vsfsim.generate.run import _kernels
    from vsfsim.physics.device import compile_kernels

    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=0, objects=objects, views=views, touches=touches, tier=None, device=device, precision="float64", renderer="warp")
    jobs: list[Job] = jobs_of(recipe, loaded.path, None, Path("."), None)
    began = time.perf_counter()
    compile_kernels(_kernels("float64", plants=True), device)
    compiling = time.perf_counter() - began
    seconds, cpu = Seconds(), resource.getrusage(resource.RUSAGE_SELF).ru_utime
    began = time.perf_counter()
    together = len(jobs) if device != "cpu" else 1
    frames, bad, met, deepest, made, segments, balance = 0, 0, 0, 0.0, 0, [], 0.0
    for start in range(0, len(jobs), together):
        subjects = []
        for job in jobs[start:start + together]:
            progress(job.name)
            subjects.append(prepare_job(job, device=device, seconds=seconds))
            segments.append(len(subjects[-1].plant.nodes) - 1)
        progress(f"touching {len(subjects)} views")
        for view in touch(subjects, device=device, seconds=seconds):
            for t in view.touches:
                made += 1
                frames += len(t.time)
                bad += int((~t.converged).sum())
                force = np.linalg.norm(t.force, axis=1)
                met += int((force > 0.0).sum())
                deepest = max(deepest, float(np.nanmax(t.audit["penetration"][t.converged], initial=0.0)))
                balance = max(balance, float(np.nanmax(t.audit["force_balance"][t.converged], initial=0.0)))
    return {"scene": loaded.name, "device": device, "machine": f"{platform.machine()}, {os.cpu_count()} CPU cores", "views": len(jobs), "touches": made, "readings": frames, "segments": segments,
            "in_contact": met, "unconverged": bad, "largest_penetration": deepest, "worst_balance": balance, "compile_s": compiling, "wall_s": time.perf_counter() - began,
            "cpu_s": resource.getrusage(resource.RUSAGE_SELF).ru_utime - cpu, "stages_s": {name: seconds.spent[name] for name in STAGES},
            "stages_cpu_s": {name: seconds.cpu[name] for name in STAGES}}


def table(found: dict[str, Any]) -> str:
    """The result for the terminal."""
    n, wall = found["readings"], found["wall_s"]
    each = 1e3 / n
    lines = [f"{found['scene']} on {found['device']} ({found['machine']}): {found['views']} views of plants with {min(found['segments'])} to {max(found['segments'])} segments, {found['touches']} touches, {n} readings",
             f"{found['in_contact']} readings in contact, {found['unconverged']} ({100 * found['unconverged'] / n:.2f} %) not converged and marked; deepest penetration {1e3 * found['largest_penetration']:.2g} mm, "
             f"worst force balance {found['worst_balance']:.1e}", "",
             f"{'stage':<12}{'s':>9}{'CPU s':>9}{'ms a reading':>15}{'CPU ms':>9}   what"]
    busy = found["stages_cpu_s"]
    lines += [f"{name:<12}{s:>9.2f}{busy[name]:>9.2f}{each * s:>15.3f}{each * busy[name]:>9.3f}   {WHAT[name]}" for name, s in found["stages_s"].items()]
    lines += [f"{'all':<12}{wall:>9.2f}{found['cpu_s']:>9.2f}{each * wall:>15.3f}{each * found['cpu_s']:>9.3f}   kernels were compiled or found before, in {found['compile_s']:.1f} s", "",
              f"{found['touches'] / wall:.2f} touches a second, {n / wall:.0f} readings a second, in one process",
              f"the papers' data set ({PAPER_TOUCHES} touches, {PAPER_READINGS} readings): {PAPER_READINGS * wall / n / 60:.0f} min in one process at this rate, "
              f"{PAPER_READINGS * found['cpu_s'] / n / 60:.0f} min of CPU time"]
    return "\n".join(lines)
