"""How alike touches of a plant are that pass some millimetres beside each other: `vsfsim measure plant-likeness`.

A touch says something of another one only as far as their readings are alike. Touches of a scene are made again on
lines that are shifted across the direction of motion, by the same arm in nearly the same postures, and the joint
torques are compared frame by frame. No estimator takes part.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.bench.protocol import as_planned
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.records import Touch
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.aim import ArmAim
from vsfsim.generate.plants.prepare import Subject, prepare_job
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.robot.arm import Arm
from vsfsim.robot.reach import Unreachable, straight_touch

SHIFTS = (0.002, 0.005, 0.01, 0.02, 0.04)
"""Distances of a line from the first one [m]."""


def measure(*, scene: str = "plants-v4-mini", objects: int | None = None, touches: int = 5, seed: int = 1,
            progress: Progress = lambda _: None) -> Measurement:
    """The difference of the torques of neighbouring touches over those of the first one, for each distance.

    Args:
        scene: name or path of a scene with ``[arm]``.
        objects: plants, None for the scene's own number.
        touches: of each plant, each of which is made again beside itself.
        seed: of the dataset.
        progress: called with the name of each plant.

    Raises:
        VsfsimError: no touch met a plant.
    """
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=seed, objects=objects, views=1, touches=touches)
    found: list[tuple[float, float, float]] = []
    for job in jobs_of(recipe, loaded.path, Path("."), None):
        subject = prepare_job(job, device="cpu")
        progress(subject.plant.name or job.name)
        found += compare(subject, np.random.default_rng((seed, job.object_index)))
    if not found:
        raise VsfsimError(f"measure plant-likeness: no touch of {loaded.name} met a plant; give more touches.")
    table = np.array(found)
    rows = []
    for shift in SHIFTS:
        mine = table[table[:, 0] == shift]
        if len(mine):
            rows.append({"shift": shift, "pairs": len(mine), "ratio": float(mine[:, 1].sum() / mine[:, 2].sum()),
                         "median": float(np.median(mine[:, 1] / mine[:, 2]))})
    return Measurement.of("plant-likeness", {"scene": loaded.name, "seed": seed, "touches": touches}, [Table(
        "touches beside each other: RMS difference of the joint torques over the RMS of the first touch", (
            Column("shift", "apart", "m", "mm", ".0f"), Column("pairs", "pairs", "1", "", "d"),
            Column("ratio", "sum over sum", "1", "", ".2f"), Column("median", "median", "1", "", ".2f")),
        rows, name="shifts")],
        notes=["The frames of a pair are those that both made as planned and found in equilibrium."])


def compare(subject: Subject, rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Of each pair: how far apart [m], the RMS difference of the torques and the RMS of the first ones [N m]."""
    arm = subject.loaded_arm()
    aims, first, apart = list(subject.aims), list(range(len(subject.aims))), [0.0] * len(subject.aims)
    for number, aim in enumerate(subject.aims):
        for shift in SHIFTS:
            try:
                aims.append(beside(arm, aim, shift, rng.uniform(0.0, 2.0 * np.pi)))
            except Unreachable:
                continue
            first.append(number)
            apart.append(shift)
    poses = np.stack([arm.body_poses(a.line) for a in aims], axis=1)
    every = dataclasses.replace(subject, arm=arm, aims=aims, poses=poses)
    (frames,) = solve([every], device="cpu")
    made = finish_touches(every, frames)
    pairs = [(shift, *difference(made[number], touch)) for number, shift, touch in zip(first, apart, made, strict=True)
             if shift > 0.0]
    return [pair for pair in pairs if pair[2] > 0.0]


def beside(arm: Arm, aim: ArmAim, shift: float, angle: float) -> ArmAim:
    """A touch whose line is ``shift`` [m] beside that of ``aim``, at an ``angle`` [rad] around its direction.

    Raises:
        Unreachable: the arm cannot follow that line.
    """
    across = np.cross(aim.axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    way = shift * (np.cos(angle) * across + np.sin(angle) * np.cross(across, aim.axis))
    turn = arm.postures(aim.line[:1]).tool[0, :3, :3]
    line = straight_touch(arm, aim.start + way, aim.stop + way, turn, frames=len(aim.line), restarts=1,
                          near=aim.line[0], table=0.0)
    return dataclasses.replace(aim, target=aim.target + way, start=aim.start + way, stop=aim.stop + way, line=line)


def difference(one: Touch, other: Touch) -> tuple[float, float]:
    """RMS difference of the torques of two touches, and RMS of the first ones [N m], over the frames that both made as
    planned; zeros where there are none."""
    assert one.planned_frame is not None and other.planned_frame is not None
    a, b = np.flatnonzero(as_planned(one)), np.flatnonzero(as_planned(other))
    _, i, j = np.intersect1d(one.planned_frame[a], other.planned_frame[b], return_indices=True)
    if not len(i):
        return 0.0, 0.0
    first, second = np.asarray(one.torque)[a[i]], np.asarray(other.torque)[b[j]]
    return float(np.sqrt(np.mean((second - first) ** 2))), float(np.sqrt(np.mean(first**2)))
