"""The rigid probe of a scene's ``[probe]``: it goes in along the normal that the camera sees, or tilted from it.

With ``mount_stiffness`` a spring along the press carries the probe. The recorded pose is then the mount's: where the
probe would be without a force.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.records import AUDIT_COLUMNS, CONTACT_COLUMNS, ObjectView, Touch
from vsfsim.generate.aim import Aim, aim_probe, give_way, mount_of
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.press_result import MeshSeries, PressRequest, PressResult
from vsfsim.generate.presses import probe as presses
from vsfsim.generate.record import audit, verdict
from vsfsim.generate.solid import batches, draw_solid, prepare
from vsfsim.generate.truth import truth_of
from vsfsim.generate.workers import make_each
from vsfsim.physics import tiers
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import times, touch_path
from vsfsim.vsf.stick_slip import stick_slip_kernel

BATCH = 9  # touches that are solved together; part of what fixes the bits


class Probe:
    """A rigid probe of simple shape; see `vsfsim.generate.effector.Effector`."""

    table = "probe"
    options = ()

    def check(self, scene: Scene, tier: str | None, precision: str) -> str:
        """The tier that the scene's needs ask for; every precision will do."""
        return tiers.choose(scene, tier)

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """The force on the probe is all that is read; every touch has it."""
        return ("min_det_f",)

    def kernels(self, scene: Scene, precision: str) -> list[Any]:
        """Those of the solver, and of the oracle VSF's stick and slip."""
        return [*solver_kernels(precision), stick_slip_kernel(wp.float64)[0]]

    def make_view(self, job: Job, *, device: str, progress: Callable[[int], None] | None = None) -> ObjectView:
        """Build, look, aim along the normals, press."""
        subject = prepare(job, device=device)
        scene = subject.scene
        aims = aim_probe(scene, subject.model, subject.view, subject.stream, device=device)
        touches = touch_all(scene, subject.model, aims, tier=job.recipe.tier, precision=job.recipe.precision,
                            device=device, progress=progress)
        truth = truth_of(subject.model, subject.view, touches, scene.probe, friction=scene.object.friction,
                         device=device)
        return subject.record(scene.probe, touches, truth)

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
        """Each view in a process of its own."""
        return make_each(jobs, device=device, workers=workers)

    def press(self, loaded: SceneFile, request: PressRequest) -> PressResult:
        """See `vsfsim.generate.presses.probe`."""
        return presses.press(loaded, request)

    def refine(self, loaded: SceneFile, request: PressRequest, meshes: int) -> MeshSeries:
        """See `vsfsim.generate.presses.probe`."""
        return presses.refine(loaded, request, meshes)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object."""
        return draw_solid(scene, seed)


EFFECTOR = Probe()


def touch_all(scene: Scene, model: Model, aims: list[Aim], *, tier: str, precision: str, device: str,
              progress: Callable[[int], None] | None = None) -> list[Touch]:
    """Simulate touches, `BATCH` at a time at most.

    Args:
        scene: with ``[touches]``.
        model: the object, at ``tier``.
        aims: the touches.
        precision: of the solver.
        device: Warp device.
        progress: called with the number of frames newly done.
    """
    spec = scene.required_touches
    out: list[Touch] = []
    for part in (aims[some] for some in batches(len(aims), BATCH)):
        planned = np.stack([touch_path(spec, scene.probe, a.contact, a.axis, depth=a.depth, approach=a.approach)
                            for a in part], axis=1)
        poses, spring = planned, scene.mount_stiffness
        if spring is not None:
            poses = np.stack([give_way(a, spec, spring, planned[:, k]) for k, a in enumerate(part)], axis=1)
        solver = Solver(model, scene.probe, friction=scene.object.friction, device=device, precision=precision,
                        options=tiers.options(tier), linear=not tiers.TIERS[tier].nonlinear)
        width = len(part)
        start = poses[0].copy()
        for pose, a in zip(start, part, strict=True):
            pose[:3, 3] = a.contact - (spec.approach if a.approach is None else a.approach) * a.axis
        frames = solver.run(poses, start=start, progress=None if progress is None else lambda _, k=width: progress(k))
        for k, a in enumerate(part):
            own = poses[:, k] if spring is None else mount_of(a, spring, poses[:, k], frames.force[:, k], planned[:, k])
            out.append(dataclasses.replace(_record(a, own, frames, k), **(_plan(planned[:, k]) if spec.plan else {})))
    return out


def _plan(poses: np.ndarray) -> dict[str, np.ndarray]:
    """The planned path of a touch as its record holds it.

    A mount on a spring is recorded where it was, which differs from its plan by what the response is not linear: that
    difference tells the force, so that a query shows the plan.
    """
    return {"planned_time": times(len(poses)), "planned_pose": poses, "planned_frame": np.arange(len(poses))}


def _record(a: Aim, poses: np.ndarray, frames: Frames, k: int) -> Touch:
    found = frames.converged[:, k] & np.isfinite(frames.force[:, k]).all(axis=1)
    return Touch(
        time=times(len(poses)), mount_pose=poses, axis=a.axis, target=a.target, normal=a.normal,
        force=frames.force[:, k], reaction=frames.reaction[:, k], residual=frames.residual[:, k],
        iterations=frames.iterations[:, k], touched=bool((frames.penetration[:, k] > 0.0).any()),
        audit=audit(frames, k, columns=(*AUDIT_COLUMNS, *CONTACT_COLUMNS)),
        **verdict(found, frames.force_balance[:, k], frames.reason[:, k]))
