"""Plants that are ready to be touched by an arm: grown, taken or drawn again, photographed, and aimed at.

A scene with ``[arm] reject_below`` refuses a plant whose touches would say nothing, or that the arm cannot reach. A few
pilot touches are made on a candidate: straight lines past random points of its surface, in the orientation of every
view, of the scene's own depth. The plant is drawn again if the arm reaches fewer than a sixtieth of the points of a
view, or if the largest norm of the joint torques in a pilot touch, in the median over these, is below the limit, the
norm that the arm's sensors show when it meets nothing. With several stations on a branch it is drawn again, too, if a
camera sees no branch that the arm can touch at all of them. The verdict depends on the seed and the object alone, so
that all views of an object, and all workers, agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Family
from vsfsim.core.system.exact import snapped
from vsfsim.data.records import View
from vsfsim.data.streams import Stream, stream
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim, NothingReached, aim_arm, load
from vsfsim.generate.plants.surface import plant_view
from vsfsim.physics.rods.model import RodModel, build
from vsfsim.physics.rods.model import grow as grow_family
from vsfsim.physics.rods.solver import RodOptions, RodSolver
from vsfsim.robot.arm import Arm, body_torque
from vsfsim.sensing.camera import look_at, seen_by

PILOTS = 4
"""Pilot touches of an object, divided among its views."""
MOST_DRAWS = 12
"""Plants that are drawn for an object before the scene is refused."""
REACHABLE = 1.0 / 60.0
"""Least share of the points that the arm reaches."""
_FRAMES = 12  # of a pilot touch
_PILOT = 1_000_000  # number of an object's pilot touches in the streams of its aims, beyond those of its own touches


@dataclass(frozen=True)
class Subject:
    """A view that is ready to be touched; without a picture and touches its outline."""

    job: Job
    """The view to make."""
    scene: Scene
    """The scene of its object."""
    plant: Plant
    """The plant as this view turns it."""
    model: RodModel
    """The plant as beams."""
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
    """The plant of a job, turned for its view, without the last bits of its numbers, in which kinds of CPU differ:
    rounding decides which branch slips off the arm."""
    scene = job.scene()
    plant = _turned(admitted(job, scene), job)
    return Subject(job, scene, plant, beams(plant, scene))


def prepare_job(job: Job, *, device: str) -> Subject:
    """The view of a job, ready to be touched: its picture is taken and its touches are chosen."""
    o = outline(job)
    view, arm = _seen(job, o.scene, o.plant, device), load(o.scene.required_arm)
    aims = _aimed(job, o.scene, o.plant, view, arm, range(o.scene.required_touches.count))
    poses = np.stack([arm.body_poses(a.line) for a in aims], axis=1)
    return dataclasses.replace(o, view=view, aims=tuple(aims), poses=poses, arm=arm)


def _turned(plant: Plant, job: Job) -> Plant:
    """The plant as a job's view turns it, without the last bits of its numbers."""
    plant = plant.turned(2.0 * np.pi * job.view_index / job.recipe.views)
    found = {f.name: getattr(plant, f.name) for f in dataclasses.fields(plant)}
    numbers: dict[str, Any] = {name: snapped(value) for name, value in found.items()
                               if isinstance(value, np.ndarray) and value.dtype.kind == "f"}
    return dataclasses.replace(plant, **numbers)


def _seen(job: Job, scene: Scene, plant: Plant, device: str) -> View:
    """The picture of a turned plant. The camera stands on a table and stays where it is while plants are turned."""
    camera, height = scene.camera, plant.nodes[:, 2]
    intrinsics, pose = look_at(camera, np.array([0.0, 0.0, 0.5 * (height.min() + height.max())]))
    return seen_by(plant_view(plant, intrinsics, pose, camera.width, camera.height, device=device,
                              renderer=job.recipe.renderer), camera, job.stream(Stream.DEPTH))


def _aimed(job: Job, scene: Scene, plant: Plant, view: View, arm: Arm, numbers: range) -> list[ArmAim]:
    """The touches of a view with these numbers, see `aim_arm`."""
    return aim_arm(arm, scene.required_arm, scene.required_touches, plant, snapped(view.points()),
                   lambda k: np.random.default_rng(job.stream(Stream.AIM, k)), numbers=numbers,
                   where=str(scene.source))


# ------------------------------------------------------------------------------------------ which plants are taken


_known: dict[tuple[object, ...], Plant] = {}
"""What this process has found before, by scene, seed, object, views and arm: the views of an object share it."""


def admitted(job: Job, scene: Scene) -> Plant:
    """The plant of a job's object, as drawn, before a view turns it; its notes say why others were drawn before it. Of
    a scene without ``reject_below`` it is the first that is drawn.

    Args:
        job: any view of the object.
        scene: the job's, with the arm that touches.

    Raises:
        SceneError: none of `MOST_DRAWS` plants can be taken; with the last reason.
    """
    if scene.required_arm.reject_below == 0.0:
        return grow(scene, job.stream(Stream.BODY), number=job.object_index)
    recipe, number = job.recipe, job.object_index
    key = recipe.scene_text, recipe.seed, number, recipe.views, scene.required_arm
    if key in _known:
        return _known[key]
    arm = load(scene.required_arm)
    refused: list[str] = []
    pilots = stream(recipe.seed, Stream.AIM, number, _PILOT)
    for draw in range(MOST_DRAWS):
        seed = stream(recipe.seed, Stream.BODY, number, *((draw,) if draw else ()))
        plant = grow(scene, seed, number=number)
        why = refusal(plant, scene, arm, recipe.views, pilots) or _no_branch(job, scene, plant, arm)
        if why is None:
            _known[key] = dataclasses.replace(plant, notes=(*plant.notes, *refused))
            return _known[key]
        refused.append(f"Draw {draw + 1} of {plant.name or 'the plant'} was refused: {why}.")
    raise SceneError(f"{scene.source}: none of {MOST_DRAWS} plants drawn for object {number} can be touched usefully. "
                     f"{refused[-1]} Move [arm] base, lower reject_below, or choose other plants.")


def _no_branch(job: Job, scene: Scene, plant: Plant, arm: Arm) -> str | None:
    """Why no branch of a view can be touched at all stations of the scene, or None. Whatever renders the pictures, the
    points are those that rays meet: pixels of OpenGL differ from machine to machine."""
    for number in range(job.recipe.views if scene.required_touches.stations > 1 else 0):
        rays = dataclasses.replace(job.recipe, renderer="warp")
        one = dataclasses.replace(job, view_index=number, recipe=rays)
        turned = _turned(plant, one)
        try:
            _aimed(one, scene, turned, _seen(one, scene, turned, "cpu"), arm, range(1))
        except NothingReached as error:
            return f"view {number}: {error.reasons}"
    return None


def grow(scene: Scene, seed: np.random.SeedSequence | int, *, number: int = 0) -> Plant:
    """The plant of a scene, as object ``number`` of its dataset.

    Raises:
        SceneError: its object is no family of plants, or a parameter is wrong.
    """
    body = scene.required_object
    shape = body.shape
    if not isinstance(shape, Family):
        raise SceneError(f"{scene.source} [arm]: an arm touches plants; give [object.shape] family "
                         f"= \"plant\", not {type(shape).__name__.lower()}.")
    plant = grow_family(shape, np.random.default_rng(seed),
                        where=f"{scene.source} [object.shape] family '{shape.name}'", number=number)
    return dataclasses.replace(plant.turned(body.yaw), poisson_ratio=body.poisson_ratio)


def beams(plant: Plant, scene: Scene) -> RodModel:
    """The plant as beams; compliance and contact penalty, which LAPACK computes, are without their last bits."""
    model = build(plant, gravity=scene.gravity)
    return dataclasses.replace(model, compliance=snapped(model.compliance), penalty=snapped(model.penalty))


def refusal(plant: Plant, scene: Scene, arm: Arm, views: int, seed: np.random.SeedSequence) -> str | None:
    """Why a plant is not taken, or None.

    Args:
        plant: as drawn.
        scene: with ``[arm]`` and ``[touches]``.
        arm: that touches.
        views: of the object.
        seed: of the pilot touches.
    """
    pilot = dataclasses.replace(scene.required_touches, frames=(1, _FRAMES, 0, 0), stations=1)
    streams = [np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, k)) for k in range(PILOTS)]
    norms: list[float] = []
    for view in range(min(views, PILOTS)):
        turned = plant.turned(2.0 * np.pi * view / views)
        points = surface_points(turned, np.random.default_rng(streams[view]), 400)
        mine = range(view, PILOTS, min(views, PILOTS))
        try:
            aims = aim_arm(arm, scene.required_arm, pilot, turned, points,
                           lambda k: np.random.default_rng(streams[k]), numbers=mine, where=str(scene.source))
        except NothingReached as error:
            return f"view {view}: {error.reasons}"
        draws = sum(a.draws for a in aims)
        if len(aims) < REACHABLE * draws:
            return f"view {view}: the arm reaches {len(aims)} of {draws} points"
        norms += torque_norms(arm, beams(turned, scene), aims, scene)
    norm, limit = float(np.median(norms)), scene.required_arm.reject_below
    if norm >= limit:
        return None
    return (f"the largest joint torques of the median pilot touch have the norm {norm:.2f} N m, "
            f"below reject_below = {limit:g} N m")


def torque_norms(arm: Arm, model: RodModel, aims: Sequence[ArmAim], scene: Scene) -> list[float]:
    """Largest norm of the joint torques of each touch [N m]; frames past the force limit and frames without an
    equilibrium are left out."""
    solver = RodSolver([model], arm.shapes, device="cpu",
                       options=RodOptions(force_limit=scene.required_touches.force_limit))
    poses = np.stack([arm.body_poses(a.line[a.plan]) for a in aims], axis=1)
    frames = solver.run(np.zeros(len(aims), int), poses, friction=scene.required_object.friction)
    out = []
    for b, aim in enumerate(aims):
        n = int(frames.frames[b])
        torque = body_torque(arm, arm.postures(aim.line[aim.plan[:n]]), frames.force[:n, b],
                             moment=frames.moment[:n, b])
        out.append(float(np.linalg.norm(torque[frames.converged[:n, b]], axis=1).max(initial=0.0)))
    return out


def surface_points(plant: Plant, rng: np.random.Generator, count: int) -> np.ndarray:
    """Random points on a plant (count, 3) [m], in proportion to the width and length of its segments."""
    area = plant.lengths() * np.maximum(plant.radius, plant.half_width)
    area[plant.nodes[:, 2] < (0.0 if plant.pot is None else plant.pot.height)] = 0.0
    area[0] = 0.0
    segment = rng.choice(len(area), count, p=area / area.sum())
    along = rng.uniform(size=(count, 1))
    parent = plant.nodes[plant.parent[segment]]
    return parent + along * (plant.nodes[segment] - parent)
