"""Which plants a dataset takes: a plant whose touches would say nothing, or that the arm cannot reach, is drawn again.

A few pilot touches are made on a candidate: straight lines past random points of its surface, in the orientation of
every view, of the scene's own depth. The plant is drawn again if the arm reaches fewer than a sixtieth of the points
of a view, or if the largest norm of the joint torques in a pilot touch, in the median over these, is below
``[arm] reject_below``, the norm that the arm's sensors show when it meets nothing. The verdict depends on the seed and
the object alone, so that all views of an object, and all workers, agree.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Family
from vsfsim.core.system.exact import snapped
from vsfsim.data.streams import Stream, stream
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim, NothingReached, aim_arm, load
from vsfsim.physics.rods.model import RodModel, build
from vsfsim.physics.rods.model import grow as grow_family
from vsfsim.physics.rods.solver import RodOptions, RodSolver
from vsfsim.robot.arm import Arm, body_torque

PILOTS = 4
"""Pilot touches of an object, divided among its views."""
MOST_DRAWS = 12
"""Plants that are drawn for an object before the scene is refused."""
REACHABLE = 1.0 / 60.0
"""Least share of the points that the arm reaches."""
_FRAMES = 12  # of a pilot touch
_PILOT = 1_000_000  # number of an object's pilot touches in the streams of its aims, beyond those of its own touches


@dataclasses.dataclass(frozen=True)
class Admitted:
    """A plant that a dataset takes."""

    plant: Plant
    """As drawn, before a view turns it."""
    refused: tuple[str, ...]
    """One sentence for each plant that was drawn before it."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a named plant is, and why others were drawn before it; empty for a plant without a name."""
        return (*self.plant.notes, *self.refused) if self.plant.name else ()


def admitted(job: Job, scene: Scene) -> Admitted:
    """The plant of a job's object; of a scene without ``reject_below`` the first that is drawn.

    Args:
        job: any view of the object.
        scene: the job's, with the arm that touches.

    Raises:
        SceneError: none of `MOST_DRAWS` plants can be taken; with the last reason.
    """
    if scene.required_arm.reject_below == 0.0:
        return Admitted(grow(scene, job.stream(Stream.BODY), number=job.object_index), ())
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
        why = refusal(plant, scene, arm, recipe.views, pilots)
        if why is None:
            _known[key] = Admitted(plant, tuple(refused))
            return _known[key]
        refused.append(f"Draw {draw + 1} of {plant.name or 'the plant'} was refused: {why}.")
    raise SceneError(f"{scene.source}: none of {MOST_DRAWS} plants drawn for object {number} can be touched usefully. "
                     f"{refused[-1]} Move [arm] base, lower reject_below, or choose other plants.")


_known: dict[tuple[object, ...], Admitted] = {}
"""What this process has found before, by scene, seed, object, views and arm: the views of an object share it."""


def grow(scene: Scene, seed: np.random.SeedSequence | int, *, number: int = 0) -> Plant:
    """The plant of a scene, as object ``number`` of its dataset.

    Raises:
        SceneError: its object is no family of plants, or a parameter is wrong.
    """
    shape = scene.required_object.shape
    if not isinstance(shape, Family):
        raise SceneError(f"{scene.source} [arm]: an arm touches plants; give [object.shape] family = \"plant\", not "
                         f"{type(shape).__name__.lower()}.")
    plant = grow_family(shape, np.random.default_rng(seed),
                        where=f"{scene.source} [object.shape] family '{shape.name}'", number=number)
    body = scene.required_object
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
    spec = scene.required_touches
    pilot = dataclasses.replace(spec, frames=(1, _FRAMES, 0, 0))
    streams = [np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, k)) for k in range(PILOTS)]
    subjects: list[tuple[RodModel, list[ArmAim]]] = []
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
        subjects.append((beams(turned, scene), aims))
    norm = float(np.median(torque_norms(arm, subjects, scene)))
    limit = scene.required_arm.reject_below
    if norm >= limit:
        return None
    return (f"the largest joint torques of the median pilot touch have the norm {norm:.2f} N m, below reject_below = "
            f"{limit:g} N m")


def torque_norms(arm: Arm, subjects: Sequence[tuple[RodModel, list[ArmAim]]], scene: Scene) -> np.ndarray:
    """Largest norm of the joint torques of each touch (B,) [N m]; frames past the force limit and frames without an
    equilibrium are left out."""
    out = []
    for model, aims in subjects:
        solver = RodSolver([model], arm.shapes, device="cpu",
                           options=RodOptions(force_limit=scene.required_touches.force_limit))
        poses = np.stack([arm.body_poses(a.angles(a.plan)) for a in aims], axis=1)
        frames = solver.run(np.zeros(len(aims), int), poses, friction=scene.required_object.friction)
        for b, aim in enumerate(aims):
            n = int(frames.frames[b])
            good = np.flatnonzero(frames.converged[:n, b])
            torque = body_torque(arm, arm.postures(aim.angles(aim.plan[:n])), frames.force[:n, b],
                                 moment=frames.moment[:n, b])
            out.append(float(np.linalg.norm(torque[good], axis=1).max(initial=0.0)))
    return np.array(out)


def surface_points(plant: Plant, rng: np.random.Generator, count: int) -> np.ndarray:
    """Random points on a plant (count, 3) [m], in proportion to the width and length of its segments."""
    area = plant.lengths() * np.maximum(plant.radius, plant.half_width)
    area[plant.nodes[:, 2] < (0.0 if plant.pot is None else plant.pot.height)] = 0.0
    area[0] = 0.0
    segment = rng.choice(len(area), count, p=area / area.sum())
    along = rng.uniform(size=(count, 1))
    parent = plant.nodes[plant.parent[segment]]
    return parent + along * (plant.nodes[segment] - parent)
