"""Joint torques of the dynamic arm less those of the kinematic one, on touches of a plant, and the time of both:
`vsfsim measure arm`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.prepare import prepare_job
from vsfsim.generate.plants.touches import JOINT_RATE, solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import kernels_of
from vsfsim.physics.runtime import compile_kernels
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm
from vsfsim.robot.dynamic import IMPEDANCE, POSITION, Drive, Motion, inertial_torque, series, simulate
from vsfsim.robot.joint_torque import body_torque
from vsfsim.robot.path import times

PARTS = ("rms", "friction", "inertia", "lag")
_WHAT = {"kinematic_rms": "J^T f, for comparison", "rms": "difference", "friction": "of it, friction in the joints",
         "inertia": "of it, inertia of the links", "lag": "of it, deviation of the joint angles"}


@dataclass(frozen=True)
class Difference:
    """The dynamic arm's readings less the kinematic arm's torques, under the same forces on the same path."""

    kinematic: np.ndarray
    """J^T f at the desired angles (T, 7) [N m]."""
    dynamic: np.ndarray
    """Readings of the dynamic arm without its weight (T, 7) [N m]."""
    rms: np.ndarray
    """Root mean square of the difference, each joint (7,) [N m]."""
    largest: np.ndarray
    """Largest difference, each joint (7,) [N m]."""
    scale: float
    """Largest kinematic torque of any joint [N m]."""
    inertia: np.ndarray
    """Rms of the part by inertia and Coriolis torques (7,) [N m]."""
    friction: np.ndarray
    """Rms of the part by friction that the sensor measures (7,) [N m]."""
    lag: np.ndarray
    """Rms of the part by the actual instead of the desired angles in J^T f (7,) [N m]."""
    tool: float
    """Largest distance of the tool from its path [m]."""
    motion: Motion
    """What the dynamic arm did."""
    seconds: tuple[float, float]
    """Computing time of the kinematic and of the dynamic arm [s]."""


def difference(arm: Arm, q: np.ndarray, times: np.ndarray, force: np.ndarray, moment: np.ndarray, *,
               drive: Drive = POSITION) -> Difference:
    """Runs both arms along ``q`` (T, 7) [rad] at ``times`` (T,) [s].

    Args:
        force, moment: on the capsules, moments about their origins (T, K, 3) [N, N m]. In the dynamic arm they move
        along with the capsules.
        drive: controller of the dynamic arm.
    """
    begin = time.perf_counter()
    kinematic = body_torque(arm, q, force, moment=moment)
    middle = time.perf_counter()
    motion = simulate(arm, q, times, series(times, force, moment), drive=drive)
    end = time.perf_counter()
    there = body_torque(arm, motion.q, force, moment=moment)
    # Friction is what remains after J^T f and inertia. Computed from the rates it would be wrong at rest, where their
    # signs are rounding errors.
    inertial = inertial_torque(arm, motion)
    gap = motion.torque - kinematic
    away = arm.postures(motion.q).tool[:, :3, 3] - arm.postures(q).tool[:, :3, 3]
    return Difference(kinematic, motion.torque, _rms(gap), np.abs(gap).max(axis=0), float(np.abs(kinematic).max()),
                      _rms(inertial), _rms(motion.torque - there - inertial), _rms(there - kinematic),
                      float(np.linalg.norm(away, axis=1).max()), motion, (middle - begin, end - middle))


def measure(*, device: str = "cpu", scene: str = "plants-mini", touches: int = 6,
            progress: Progress = lambda _: None) -> Measurement:
    """Touch one plant, then lead both arms along the same path under the same wrenches.

    Args:
        device: Warp device of the plant.
        scene: name or path of a scene with [arm].
        touches: number of touches of the plant.
        progress: called with what is going on.
    """
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, objects=1, views=1, touches=touches, device=device)
    job = jobs_of(recipe, loaded.path, Path("."), None)[0]
    progress("compiling kernels, or finding them")
    compile_kernels(kernels_of(loaded.sample(0)), device)
    subject = prepare_job(job, device=device)
    progress("touching")
    (frames,) = solve([subject], device=device)
    assert subject.arm is not None
    rows, parts, notes = [], [], []
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
                     "seconds": np.sum([d.seconds for d in found], axis=0).tolist() if found else [None, None]})
        if not found:
            notes.append(f"{name} drive: no touch met the plant; ask for more --touches.")
        parts += [{"drive": name, "part": _WHAT[part], "torque": rows[-1][part]} for part in _WHAT if found]
    return Measurement.of("arm", {"device": device, "scene": loaded.name, "touches": touches}, [
        Table("two drives of the dynamic arm, on the path and under the wrenches of the kinematic one", (
            Column("drive", "drive"), Column("touches", "touches", "1"),
            Column("scale", "largest torque", "N m", form=".2f"),
            Column("tool_m", "largest deviation of the tool", "m", "mm", ".2f"),
            Column("seconds.0", "kinematic", "s", form=".2f"), Column("seconds.1", "dynamic", "s", form=".2f")),
            rows, name="rows"),
        Table("torque readings of the dynamic arm less J^T f, rms over touches [N m]", (
            Column("drive", "drive"), Column("part", "part"),
            *(Column(f"torque.{j}", f"joint {j + 1}", form=".3f") for j in range(gen3.JOINTS))),
            parts)] if parts else [], notes=notes, numbers={"scene": loaded.name})


def _joined(values: list[np.ndarray]) -> list[float]:
    return np.sqrt(np.mean(np.square(values), axis=0)).tolist() if values else []


def _rms(values: np.ndarray) -> np.ndarray:
    return np.sqrt((values**2).mean(axis=0))
