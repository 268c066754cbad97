"""The robot arm of a scene's ``[arm]``: it touches plants with its tool and its links, and reads its joint torques."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.records import ObjectView, Touch
from vsfsim.generate.effector import Drawing, kernels_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.plants.aim import ArmAim
from vsfsim.generate.plants.subject import Subject, grow, prepare_job
from vsfsim.generate.plants.surface import plant_surface, triangles_of
from vsfsim.generate.plants.touches import finish_touches, make_together, make_view, solve
from vsfsim.generate.press_result import BodyPanel, Column, PressResult, frames_done
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.workers import make_each
from vsfsim.physics.rods.kernels.advance import advance
from vsfsim.physics.rods.solver import RodFrames
from vsfsim.physics.runtime import compile_kernels
from vsfsim.sensing.camera import look_at
from vsfsim.sensing.tessellate import tessellate
from vsfsim.vsf.stick_slip import stick_slip


class ArmEffector:
    """An arm with seven joints; see `vsfsim.generate.effector.Effector`."""

    table = "arm"

    def check(self, scene: Scene, tier: str | None) -> str:
        """Plants are made of beams: tier "rod".

        Raises:
            SceneError: another tier was asked for.
        """
        if (tier or "rod") not in ("rod", "auto"):
            raise SceneError(f"{scene.source}: --tier is '{tier}', but what an arm touches is made "
                             "of beams, tier 'rod'.")
        return "rod"

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Joint angles and torques, and the wrenches on the links."""
        return ("q", "torque", "link_force", "link_moment", "draws")

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the beams' solver, and of the oracle VSF's stick and slip."""
        return [advance, stick_slip]

    def make_view(self, job: Job, *, device: str) -> ObjectView:
        """Grow, look, aim along lines that the arm can follow, touch."""
        return make_view(job, device=device)

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
        """On a CPU each view in a process of its own; on a GPU the touches of many views are solved together."""
        make = make_each if device == "cpu" else make_together
        return make(jobs, device=device, workers=workers)

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """The first touch that `vsfsim generate` would make of this seed.

        Raises:
            SceneError: the scene has no [touches], a tier that beams do not have, or nothing that the arm can reach.
        """
        began = time.perf_counter()
        recipe = make_recipe(loaded, seed=request.seed, objects=1, views=1, touches=1,
                             tier=request.tier, device=request.device)
        job = jobs_of(recipe, loaded.path, Path("."))[0]
        compile_kernels(kernels_of(loaded.sample(request.seed)), request.device, progress=request.progress)
        subject = prepare_job(job, device=request.device)
        built = time.perf_counter() - began
        began = time.perf_counter()
        (aim,) = subject.aims
        tell = frames_done(request.progress, len(aim.plan))
        frames = solve([subject], device=request.device, progress=tell, keep_nodes=True)
        (touch,) = finish_touches(subject, frames)
        seconds = time.perf_counter() - began
        n = len(touch.time)
        depth, size = (touch.mount_pose[:, :3, 3] - aim.target) @ aim.axis, np.linalg.norm(touch.force, axis=1)
        assert touch.q is not None and touch.torque is not None
        q, full, segments = touch.q, int(np.argmax(depth)), len(subject.plant.nodes) - 1
        contacts = frames.contacts[:n, 0]
        return PressResult(
            touch, depth, full,
            more={"torque": touch.torque, "q": q, "target": aim.target, "draws": aim.draws,
                  "contacts": contacts, "segments": segments, "deepest": full,
                  "build_seconds": built,
                  "seconds": seconds, "tier": recipe.tier, "device": request.device},
            first=(Column("tool mm past target", 1e3 * depth, ".2f"),
                   Column("|force| N", size, ".4f")),
            readings=(*(Column(f"joint {j + 1}{' N m' * (j == 6)}", touch.torque[:, j], ".4f")
                        for j in range(7)), Column("contacts", contacts, "d")),
            said=("Torques are those of the contact; the weight of the arm is taken off.",
                  f"{segments} segments, tier {recipe.tier} on {request.device}; plant, picture "
                  f"and path in {built:.1f} s, solved in {seconds:.1f} s."),
            notes=tuple(_notes(subject, aim, touch, frames)),
            plot={"size of the force [N]": {"force on the arm": size},
                  "joint torque of the contact [N m]": {f"joint {j + 1}": touch.torque[:, j]
                                                        for j in range(7)}},
            abscissa="tool past its target [mm], below 0 before it", model=f"plant of {segments} segments",
            headline=f"tool {1e3 * abs(depth[full]):.0f} mm {'past' if depth[full] >= 0.0 else 'before'} its target, "
                     f"|force| {size[full]:.3g} N",
            panels=lambda t: (_panel(subject, q, frames, t),), arrays=_arrays(subject, q, frames))

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """Raises:
            SceneError: always; a plant has the segments of its family.
        """
        raise SceneError(f"--refine {meshes}: a plant has the segments that its family gave it, and no finer mesh; "
                         f"leave --refine out, or make segment in [object.shape] smaller.")

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The plant without its pot, and the sections and moduli of its parts in words."""
        plant = grow(scene, seed)
        lines = [f"{len(plant.nodes) - 1} segments, {plant.lengths().sum():.2f} m in all, "
                 f"{plant.nodes[:, 2].max():.2f} m high, tier rod"]
        for index, region in enumerate(plant.region_names):
            mine = np.flatnonzero(plant.region[1:] == index) + 1
            if len(mine):
                e, r = plant.young_modulus[mine], plant.radius[mine]
                lines.append(f"  {region:<14} {len(mine):4d} segments, E {e.min():9.3g} to "
                             f"{e.max():9.3g} Pa, "
                             f"{'half thickness' if plant.half_width[mine].any() else 'radius'} "
                             f"{1e3 * r.min():.2g} to {1e3 * r.max():.2g} mm")
        lines.extend(f"note: {sentence}" for sentence in plant.notes)
        modulus = np.repeat(plant.young_modulus[1:], triangles_of(plant)[1:])
        return Drawing(plant_surface(plant, pot=False), modulus, None, tuple(lines))


EFFECTOR = ArmEffector()


def _notes(subject: Subject, aim: ArmAim, touch: Touch, frames: RodFrames) -> list[str]:
    """What was decided, and why the touch ended."""
    limit = subject.scene.touches
    assert limit is not None
    n, planned = len(touch.time), len(aim.plan)
    out = [*subject.plant.notes,
           f"target {aim.draws} of those drawn was within reach: ({', '.join(f'{v:.3f}' for v in aim.target)}) m, "
           f"the tool goes along ({', '.join(f'{v:.3f}' for v in aim.axis)})"]
    if n < planned:
        out.append(f"the touch ends at frame {n} of {planned}: in the next the contact force would "
                   f"pass force_limit = {limit.force_limit:g} N")
    elif not touch.touched:
        out.append("the arm touched nothing on its way; take another --seed")
    return out


def _arrays(subject: Subject, q: np.ndarray, frames: RodFrames) -> dict[str, tuple[np.ndarray, str]]:
    assert subject.arm is not None and frames.nodes is not None and frames.turns is not None
    n, plant = len(q), subject.plant
    return {
        "node_position": (frames.nodes[:n, 0], "of the plant (T, n, 3) [m]"),
        "node_rotation": (frames.turns[:n, 0], "quaternions x y z w since rest (T, n, 4)"),
        "node_rest": (plant.nodes, "(n, 3) [m]"), "parent": (plant.parent, "of each node (n,)"),
        "radius": (plant.radius, "of the segment to each node (n,) [m]"),
        "young_modulus": (plant.young_modulus, "of the segment (n,) [Pa]"),
        "capsule_pose": (subject.arm.body_poses(q), "of the arm's capsules (T, K, 4, 4) [m]"),
        "body_force": (frames.force[:n, 0], "on each capsule (T, K, 3) [N]"),
        "body_moment": (frames.moment[:n, 0], "about its origin (T, K, 3) [N m]")}


def _panel(subject: Subject, q: np.ndarray, frames: RodFrames, t: int) -> BodyPanel:
    """Plant and arm in frame ``t``, from the scene's camera; ``q``: joint angles (T, 7) [rad]."""
    arm, camera, plant = subject.arm, subject.scene.camera, subject.plant
    assert arm is not None and frames.nodes is not None and frames.turns is not None
    body = plant_surface(plant, pot=True, nodes=frames.nodes[t, 0],
                         turns=Rotation.from_quat(frames.turns[t, 0]).as_matrix())
    rigid = tuple((v @ pose[:3, :3].T + pose[:3, 3], f)
                  for (v, f), pose in zip((tessellate(shape, 1.0) for shape in arm.shapes),
                                          arm.body_poses(q)[t], strict=True))
    middle = 0.5 * (plant.nodes.min(axis=0) + plant.nodes.max(axis=0))
    return BodyPanel(body, look_at(camera, np.array([0.0, 0.0, middle[2]])), (camera.width, camera.height), rigid)
