"""What yielding wires change in the touches of artificial plants: `vsfsim measure plant-yield`.

The touches of a scene are made twice, by the same arm on the same ways: on its plants, whose wires yield, and on plants
with the same sections whose wires do not.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.prepare import Subject, prepare_job
from vsfsim.generate.plants.touches import solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics.rods.model import build
from vsfsim.physics.rods.solver import RodFrames
from vsfsim.robot.joint_torque import body_torque

NOISE = 1.2
"""Norm of the torques that a real Gen3 shows when it meets nothing [N m]."""


def measure(*, scene: str = "plants-v4-mini", objects: int | None = None, touches: int = 6, seed: int = 0,
            progress: Progress = lambda _: None) -> Measurement:
    """Share of the touches whose wires yield, what that changes in forces and torques, and how far plants stay bent.

    Args:
        scene: name or path of a scene of the family `artificial_plant`.
        objects: plants, None for the scene's own number.
        touches: of each plant.
        seed: of the dataset.
        progress: called with the name of each plant.

    Raises:
        VsfsimError: no wire of any plant yields by its law.
    """
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=seed, objects=objects, views=1, touches=touches)
    rows: list[dict[str, Any]] = []
    every: list[dict[str, float]] = []
    for job in jobs_of(recipe, loaded.path, Path("."), None):
        subject = prepare_job(job, device="cpu")
        progress(subject.plant.name or job.name)
        if subject.plant.yielding is None:
            continue
        found = compare(subject)
        every += found
        column = {key: np.array([row[key] for row in found]) for key in found[0]}
        yields = column["yields"] > 0.0
        rows.append({"name": subject.plant.name, "touches": len(found), "share": float(yields.mean()),
                     **{key: float(np.median(column[key])) for key in ("force", "elastic_force", "norm", "change")},
                     "bent": float(np.median(column["bent"][np.isfinite(column["bent"])]))
                     if np.isfinite(column["bent"]).any() else float("nan")})
    if not rows:
        raise VsfsimError(f"measure plant-yield: no wire of {loaded.name} yields; give a scene of the family "
                          f"artificial_plant without yields = false.")
    yields, change, force, elastic = (np.array([row[key] for row in every])
                                      for key in ("yields", "change", "force", "elastic_force"))
    past, loud = float((yields > 0.0).mean()), float((change > NOISE).mean())
    less = float(np.median(force) / np.median(elastic))
    return Measurement.of("plant-yield", {"scene": loaded.name, "seed": seed, "touches": touches}, [Table(
        "touches of plants whose wires yield, beside the same touches of elastic ones; medians of each plant", (
            Column("name", "plant"), Column("touches", "touches", "1", "", "d"),
            Column("share", "in which a wire yields", "1", "%", ".0f"),
            Column("force", "RMS force", "N", "", ".2f"), Column("elastic_force", "elastic", "N", "", ".2f"),
            Column("norm", "torque norm", "N m", "", ".2f"), Column("change", "its change", "N m", "", ".2f"),
            Column("bent", "stays bent by", "m", "mm", ".1f")), rows, name="plants")],
        notes=[f"In {100 * past:.0f} % of {len(every)} touches a wire yields; in {100 * loud:.0f} % the torques change "
               f"by more than {NOISE:g} N m (RMS of the norm), what a real arm shows when it meets nothing.",
               f"The median touch has {less:.2f} of the force that elastic wires have."],
        numbers={"share_yielding": past, "share_above_noise": loud, "force_ratio": less})


def compare(subject: Subject) -> list[dict[str, float]]:
    """Of each touch: the heat of yielding [J], RMS forces [N], the RMS norm of the torques and of their change [N m],
    and how far a node stays away from its place after the touch [m], NaN where the touch has no end."""
    stiff = dataclasses.replace(subject, model=build(dataclasses.replace(subject.plant, yielding=None),
                                                     gravity=subject.scene.gravity))
    (frames,) = solve([subject], device="cpu", keep_nodes=True)
    (elastic,) = solve([stiff], device="cpu")
    assert frames.nodes is not None
    out = []
    for b, aim in enumerate(subject.aims):
        n = int(min(frames.frames[b], elastic.frames[b]))
        good = np.flatnonzero(frames.converged[:n, b] & elastic.converged[:n, b])
        torque, other = (_torque(subject, f, b, good) for f in (frames, elastic))
        whole = frames.frames[b] == len(aim.plan) and frames.contacts[-1, b] == 0
        away = np.linalg.norm(frames.nodes[-1, b] - subject.plant.nodes, axis=1).max() if whole else np.nan
        out.append({"yields": float(np.nanmax(frames.heat[:, b])), "force": _rms(frames.force[good, b].sum(axis=1)),
                    "elastic_force": _rms(elastic.force[good, b].sum(axis=1)), "norm": _rms(torque),
                    "change": _rms(torque - other), "bent": float(away)})
    return out


def _torque(subject: Subject, frames: RodFrames, b: int, good: np.ndarray) -> np.ndarray:
    arm, aim = subject.loaded_arm(), subject.aims[b]
    return body_torque(arm, aim.angles(aim.plan[good]), frames.force[good, b], moment=frames.moment[good, b])


def _rms(vectors: np.ndarray) -> float:
    """Root mean square of the norms of (T, d)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else 0.0
