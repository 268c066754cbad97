"""Plants that are ready to be touched by an arm: grown, photographed, and aimed at."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.core.plant import Plant
from vsfsim.core.scene import Scene
from vsfsim.core.system.exact import snapped
from vsfsim.data.records import View
from vsfsim.data.streams import Stream
from vsfsim.generate.job import Job
from vsfsim.generate.plants.admit import admitted, beams
from vsfsim.generate.plants.aim import ArmAim, aim_arm, load
from vsfsim.generate.plants.surface import plant_view
from vsfsim.physics.rods.model import RodModel
from vsfsim.robot.arm import Arm
from vsfsim.sensing.camera import look_at, seen_by


@dataclass(frozen=True)
class Subject:
    """A view that is ready to be touched, or some touches of it; without a picture and touches its outline."""

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
    view: View | None = None
    """Its picture."""
    aims: tuple[ArmAim, ...] = ()
    """The touches."""
    poses: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0, 4, 4)))
    """Poses of the arm's capsules along the lines of the touches (P, B, K, 4, 4) [m]."""
    arm: Arm | None = None
    """The arm, or None in another process than the one that loaded it: its simulator does not travel."""

    def loaded_arm(self) -> Arm:
        """The arm; loaded anew in a process to which it did not travel."""
        return self.arm or load(self.scene.required_arm)


def outline(job: Job) -> Subject:
    """The plant of a job, turned for its view."""
    r, scene = job.recipe, job.scene()
    found = admitted(job, scene)
    plant = _snapped(found.plant.turned(2.0 * np.pi * job.view_index / r.views))
    return Subject(job, scene, plant, beams(plant, scene), found.notes)


def _snapped(plant: Plant) -> Plant:
    """The plant without the last bits of its numbers, in which kinds of CPU differ: rounding decides which branch slips
    off the arm."""
    found = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    numbers: dict[str, Any] = {name: snapped(value) for name, value in found.items()
                               if isinstance(value, np.ndarray) and value.dtype.kind == "f"}
    return dataclasses.replace(plant, **numbers)


def prepare_job(job: Job, *, device: str) -> Subject:
    """The view of a job, ready to be touched: its picture is taken and its touches are chosen."""
    o = outline(job)
    view = look(o, device=device)
    return dataclasses.replace(choose(o, view.points(), range(o.scene.required_touches.count)), view=view)


def look(o: Subject, *, device: str) -> View:
    """What the scene's camera sees of the plant. The camera stands on a table and stays where it is while plants are
    turned."""
    camera, height = o.scene.camera, o.plant.nodes[:, 2]
    intrinsics, pose = look_at(camera, np.array([0.0, 0.0, 0.5 * (height.min() + height.max())]))
    view = plant_view(o.plant, intrinsics, pose, camera.width, camera.height, device=device,
                      renderer=o.job.recipe.renderer)
    return seen_by(view, camera, o.job.stream(Stream.DEPTH))


def choose(o: Subject, cloud: np.ndarray, numbers: range) -> Subject:
    """With the touches ``numbers`` of a view whose visible cloud (n, 3) [m] is given, and with the arm."""
    spec = o.scene.required_arm
    arm = load(spec)
    aims = aim_arm(arm, spec, o.scene.required_touches, o.plant, snapped(cloud),
                   lambda k: np.random.default_rng(o.job.stream(Stream.AIM, k)), numbers=numbers,
                   where=str(o.scene.source))
    return dataclasses.replace(o, aims=tuple(aims), poses=np.stack([arm.body_poses(a.line) for a in aims], axis=1),
                               arm=arm)
