"""`vsfsim measure arm`: what the dynamic arm reads and the kinematic one does not, on touches of plants, and what each
costs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.prepare import prepare_job
from vsfsim.generate.plants.touches import JOINT_RATE, solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import kernels_of
from vsfsim.physics.runtime import compile_kernels
from vsfsim.robot.arm_modes import Difference, difference
from vsfsim.robot.dynamic import IMPEDANCE, POSITION
from vsfsim.robot.path import times

PARTS = ("rms", "friction", "inertia", "lag")
WHAT = {"rms": "all of it", "friction": "friction that the torque sensors see", "inertia": "masses that are moved",
        "lag": "the same forces at angles a little off"}


def bench(*, device: str, scene: str, touches: int, progress: Callable[[str], None]) -> dict[str, Any]:
    """Touch one plant, then lead both arms along the same path under the same wrenches.

    Args:
        device: Warp device of the plant. scene: name or path, with [arm]. touches: how many that meet the plant.
        progress: called with what is going on.
    """
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=0, objects=1, views=1, touches=touches, tier=None, device=device,
                         precision="float64", renderer="warp")
    job = jobs_of(recipe, loaded.path, Path("."), None)[0]
    progress("compiling kernels, or finding them")
    compile_kernels(kernels_of(loaded.sample(0), "float64"), device)
    subject = prepare_job(job, device=device)
    progress("touching")
    (frames,) = solve([subject], device=device)
    assert subject.arm is not None
    rows = []
    for name, drive in (("position", POSITION), ("impedance", IMPEDANCE)):
        found: list[Difference] = []
        for b, a in enumerate(subject.aims):
            n = int(frames.frames[b])
            good = np.flatnonzero(frames.converged[:n, b])
            q = a.angles(frames.where[good, b])
            force = frames.force[good, b]
            if len(good) < 3 or not np.abs(force).any():
                continue
            progress(f"{name} drive, touch {b}")
            time_ = times(n)[good]
            time_ = time_ * max(1.0, float(np.abs(np.diff(q, axis=0)).max() / np.diff(time_).min()) / JOINT_RATE)
            found.append(difference(subject.arm, q, time_, force, frames.moment[good, b], drive=drive))
        rows.append({"drive": name, "touches": len(found), "scale": max((d.scale for d in found), default=0.0),
                     "kinematic_rms": _joined([np.sqrt((d.kinematic**2).mean(axis=0)) for d in found]),
                     **{part: _joined([getattr(d, part) for d in found]) for part in PARTS},
                     "largest": np.max([d.largest for d in found], axis=0).tolist() if found else [],
                     "tool_m": max((d.tool for d in found), default=0.0),
                     "seconds": np.sum([d.seconds for d in found], axis=0).tolist() if found else []})
    return {"scene": loaded.name, "rows": rows}


def _joined(values: list[np.ndarray]) -> list[float]:
    return np.sqrt(np.mean(np.square(values), axis=0)).tolist() if values else []


def table(found: dict[str, Any]) -> str:
    """The result for the terminal."""
    lines = [f"{found['scene']}: the dynamic arm's readings less J^T f of the kinematic arm, the same wrenches on the "
             f"same path; rms over touches, each joint [N m]"]
    for row in found["rows"]:
        if not row["touches"]:
            lines.append(f"{row['drive']} drive: no touch met the plant; ask for more --touches")
            continue
        lines += ["", f"{row['drive']} drive, {row['touches']} touches, torques to {row['scale']:.2f} N m; the tool "
                      f"leaves its path by {1e3 * row['tool_m']:.2f} mm at most; "
                  f"{row['seconds'][0]:.2f} s kinematic, {row['seconds'][1]:.2f} s dynamic",
                  f"{'':<14}" + "".join(f"{f'joint {j + 1}':>9}" for j in range(len(row["rms"])))]
        lines.append(f"{'J^T f':<14}" + "".join(f"{v:>9.3f}" for v in row["kinematic_rms"]) + "   for comparison")
        lines += [f"{'difference' if name == 'rms' else name:<14}" + "".join(f"{v:>9.3f}" for v in row[name])
                  + f"   {WHAT[name]}" for name in PARTS]
    return "\n".join(lines)
