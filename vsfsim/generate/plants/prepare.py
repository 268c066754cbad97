"""Plants that are ready to be touched by an arm: grown, photographed, and aimed at."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.core.plant import Plant
from vsfsim.core.scene import CameraSpec, Scene
from vsfsim.core.system.exact import snapped
from vsfsim.data.records import View
from vsfsim.data.streams import Stream
from vsfsim.generate.job import Job
from vsfsim.generate.plants.admit import admitted, beams
from vsfsim.generate.plants.aim import ArmAim, aim_arm, load
from vsfsim.generate.plants.surface import plant_view
from vsfsim.physics.rods.model import RodModel
from vsfsim.robot.arm import Arm
from vsfsim.sensing.camera import look_at
from vsfsim.sensing.kinect import seen_by


@dataclass
class Seconds:
    """Where the time goes, stage by stage."""

    spent: Counter = field(default_factory=Counter)
    """Time on the clock of each stage [s]."""
    cpu: Counter = field(default_factory=Counter)
    """CPU time of this process in each stage [s]."""
    _last: float = field(default_factory=time.process_time)

    def begin(self) -> float:
        """Start a stage; returns the time on the clock [s], for `charge`."""
        self._last = time.process_time()
        return time.perf_counter()

    def charge(self, stage: str, since: float) -> float:
        """End a stage and start the next one; returns the time on the clock [s]."""
        now, busy = time.perf_counter(), time.process_time()
        self.spent[stage] += now - since  # type: ignore[assignment]  # a Counter of seconds
        self.cpu[stage] += busy - self._last  # type: ignore[assignment]
        self._last = busy
        return now

    def add(self, other: Seconds) -> None:
        """Add the time of another process."""
        self.spent.update(other.spent)
        self.cpu.update(other.cpu)


@dataclass(frozen=True)
class Outline:
    """A view before its picture is taken."""

    job: Job
    """The view to make."""
    scene: Scene
    """The scene of its object."""
    plant: Plant
    """The plant as this view turns it."""
    model: RodModel
    """The plant as beams."""
    notes: tuple[str, ...] = ()
    """What the plant is, and why others were drawn before it; empty for a plant without a name."""


def outline(job: Job) -> Outline:
    """The plant of a job, turned for its view."""
    r, scene = job.recipe, job.scene()
    found = admitted(job, scene)
    plant = _snapped(found.plant.turned(2.0 * np.pi * job.view_index / r.views))
    return Outline(job, scene, plant, beams(plant, scene), found.notes)


def _snapped(plant: Plant) -> Plant:
    """The plant without the last bits of its numbers, in which kinds of CPU differ: rounding decides which branch slips
    off the arm."""
    found = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    numbers: dict[str, Any] = {name: snapped(value) for name, value in found.items()
                               if isinstance(value, np.ndarray) and value.dtype.kind == "f"}
    return dataclasses.replace(plant, **numbers)


@dataclass(frozen=True)
class Subject:
    """A view that is ready to be touched, or some touches of it."""

    job: Job
    """The view to make."""
    scene: Scene
    """The scene of its object, with the arm that touches."""
    plant: Plant
    """The plant as this view turns it."""
    model: RodModel
    """The plant as beams."""
    view: View
    """Its picture."""
    aims: list[ArmAim]
    """The touches."""
    poses: np.ndarray
    """Poses of the arm's capsules along the lines of the touches (P, B, K, 4, 4) [m]."""
    notes: tuple[str, ...] = ()
    """As of `Outline`."""
    arm: Arm | None = None
    """The arm, or None in another process than the one that loaded it: its simulator does not travel."""

    def loaded_arm(self) -> Arm:
        """The arm; loaded anew in a process to which it did not travel."""
        return self.arm or load(self.scene.required_arm)


def prepare_job(job: Job, *, device: str, seconds: Seconds | None = None) -> Subject:
    """The view of a job, ready to be touched: its picture is taken and its touches are chosen."""
    seconds = seconds or Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    view = look(o, device=device, seconds=seconds)
    arm, aims, poses = choose(o, view.points(), range(o.scene.required_touches.count), seconds=seconds)
    return Subject(job, o.scene, o.plant, o.model, view, aims, poses, o.notes, arm)


def look(o: Outline, *, device: str, seconds: Seconds) -> View:
    """What the scene's camera sees of the plant."""
    since = seconds.begin()
    view = see(o.plant, o.scene.camera, device=device, renderer=o.job.recipe.renderer)
    view = seen_by(view, o.scene.camera, o.job.stream(Stream.DEPTH))
    seconds.charge("look", since)
    return view


def choose(o: Outline, cloud: np.ndarray, numbers: range, *, seconds: Seconds) -> tuple[Arm, list[ArmAim], np.ndarray]:
    """The scene's arm, the touches ``numbers`` of a view whose visible cloud (n, 3) [m] is given, and the poses of the
    arm's capsules along their lines (P, B, K, 4, 4) [m]."""
    since = seconds.begin()
    spec = o.scene.required_arm
    arm = load(spec)
    aims = aim_arm(arm, spec, o.scene.required_touches, o.plant, snapped(cloud),
                   lambda k: np.random.default_rng(o.job.stream(Stream.AIM, k)), numbers=numbers,
                   where=str(o.scene.source))
    since = seconds.charge("aim", since)
    poses = np.stack([arm.body_poses(a.line) for a in aims], axis=1)
    seconds.charge("kinematics", since)
    return arm, aims, poses


def see(plant: Plant, camera: CameraSpec, *, device: str, renderer: str) -> View:
    """The picture of a table camera that stands still while plants are turned."""
    low, high = plant.nodes.min(axis=0), plant.nodes.max(axis=0)
    intrinsics, pose = look_at(camera, np.array([0.0, 0.0, 0.5 * (low[2] + high[2])]))
    return plant_view(plant, intrinsics, pose, camera.width, camera.height, device=device, renderer=renderer)
