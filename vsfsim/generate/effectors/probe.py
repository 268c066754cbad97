"""The rigid probe of a scene's ``[probe]``: it goes in along the normal that the camera sees, or tilted from it.

With ``mount_stiffness`` a spring along the press carries the probe. The recorded poses are the mount's, which are as
planned; the probe is where the spring and the contact balance, see `vsfsim.physics.solve.mount`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.records import AUDIT_COLUMNS, CONTACT_COLUMNS, MESH_COLUMNS, ObjectView, Touch
from vsfsim.generate.aim import Aim, aim_probe, in_kinds, starts
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.press_result import MeshSeries, PressRequest, PressResult
from vsfsim.generate.presses import probe as one_press
from vsfsim.generate.record import audit, verdict
from vsfsim.generate.solid import Manner, Subject, batches, draw_solid, prepare
from vsfsim.generate.trade.audit import audited
from vsfsim.generate.truth import truth_of
from vsfsim.generate.workers import make_each
from vsfsim.physics import tiers
from vsfsim.physics.contact import sdf
from vsfsim.physics.mesh.resolved import resolved
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.mount import Mount
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import times, touch_path
from vsfsim.vsf.stick_slip import stick_slip

# touches that are solved together, on a CPU as many as share a back-solve; part of what fixes the bits
BATCH = {"cpu": 16, "cuda": 64}


class Probe:
    """A rigid probe of simple shape; see `vsfsim.generate.effector.Effector`."""

    table = "probe"
    options: tuple[str, ...] = ()

    def check(self, scene: Scene, tier: str | None) -> str:
        """The tier that the scene's needs ask for."""
        return tiers.choose(scene, tier)

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """The force on the probe is all that is read; every touch has it."""
        return ("min_det_f",)

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the solver, and of the oracle VSF's stick and slip."""
        own = tiers.elements(scene, tiers.choose(scene))
        return [*solver_kernels(own), stick_slip]

    def make_view(self, job: Job, *, device: str, progress: Callable[[int], None] | None = None) -> ObjectView:
        """Build, look, aim along the normals, press."""
        subject = prepare(job, device=device)
        scene = subject.scene
        aims = self.aim(subject, device=device)
        touches = audited(self, subject, aims, device=device, progress=progress)
        truth = truth_of(subject.model, subject.view, touches, [scene.presses[a.press].probe for a in aims],
                         friction=scene.required_object.friction, device=device)
        return subject.record(scene.probe, touches, truth)

    def manner(self, scene: Scene) -> Manner:
        """With its largest radius, at every tier."""
        return Manner(min(sdf.reach(scene.probe), 1.0), tuple(tiers.TIERS))

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return aim_probe(subject.scene, subject.model, subject.view, subject.stream, device=device)

    def touch(self, subject: Subject, aims: list[Aim], *, device: str, progress: Callable[[int], None] | None = None,
              paths: Sequence[np.ndarray] = ()) -> list[Touch]:
        """See `touch_all`; touches of one kind of press together."""
        recipe, presses = subject.job.recipe, subject.scene.presses

        def make(press: Scene, mine: list[int]) -> list[Touch]:
            found = touch_all(press, subject.model, [aims[k] for k in mine], tier=recipe.tier,
                              device=device, options=subject.limits(), progress=progress,
                              paths=[paths[k] for k in mine] if len(paths) else ())
            return found if len(presses) == 1 else [dataclasses.replace(touch, press=aims[k].press)
                                                    for k, touch in zip(mine, found, strict=True)]

        return in_kinds(presses, aims, make)

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
        """Each view in a process of its own."""
        return make_each(jobs, device=device, workers=workers)

    def press(self, loaded: SceneFile, request: PressRequest) -> PressResult:
        """See `vsfsim.generate.presses.probe`."""
        return one_press.press(loaded, request)

    def refine(self, loaded: SceneFile, request: PressRequest, meshes: int) -> MeshSeries:
        """See `vsfsim.generate.presses.probe`."""
        return one_press.refine(loaded, request, meshes)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object."""
        return draw_solid(scene, seed)


EFFECTOR = Probe()


def touch_all(scene: Scene, model: Model, aims: list[Aim], *, tier: str, device: str,
              options: SolverOptions | None = None, progress: Callable[[int], None] | None = None,
              paths: Sequence[np.ndarray] = ()) -> list[Touch]:
    """Simulate touches, `BATCH` at a time at most.

    Args:
        scene: with ``[touches]``.
        model: the object, at ``tier``.
        aims: the touches.
        device: Warp device.
        options: solver limits, None for the tier's own.
        progress: called with the number of frames newly done.
        paths: (T, 4, 4) of each touch; () for those of the aims.
    """
    spec = scene.required_touches
    paths = paths or [touch_path(spec, scene.probe, a.contact, a.axis, depth=a.depth, approach=a.approach)
                      for a in aims]
    out: list[Touch] = []
    for some in batches(len(aims), BATCH[device.split(":")[0]]):
        part, poses = aims[some], np.stack(paths[some], axis=1)
        spring = scene.mount_stiffness
        mount = None if spring is None else Mount(spring, np.stack([a.axis for a in part]))
        solver = Solver(model, scene.probe, friction=scene.required_object.friction, device=device,
                        options=options or tiers.options(tier), linear=not tiers.TIERS[tier].nonlinear)
        width = len(part)
        frames = solver.run(poses, start=starts(spec, part, poses[0]), mount=mount,
                            progress=None if progress is None else lambda _, k=width: progress(k))  # type: ignore[misc]
        out += [dataclasses.replace(_record(a, poses[:, k], frames, k, solver), mount_stiffness=spring)
                for k, a in enumerate(part)]
    return out


def _record(a: Aim, poses: np.ndarray, frames: Frames, k: int, solver: Solver) -> Touch:
    mesh = MESH_COLUMNS if np.isfinite(frames.mesh_error[:, k]).all() else ()
    held = resolved(frames.mesh_error[:, k], frames.corner_det_f[:, k], solver.linear * frames.rotation[:, k],
                    frames.converged[:, k], solver.model.solid.parts) if mesh else None
    found = frames.converged[:, k] & np.isfinite(frames.force[:, k]).all(axis=1)
    return Touch(
        time=times(len(poses)), mount_pose=poses, axis=a.axis, target=a.target, normal=a.normal,
        force=frames.force[:, k], reaction=frames.reaction[:, k], residual=frames.residual[:, k],
        iterations=frames.iterations[:, k], touched=bool((frames.penetration[:, k] > 0.0).any()),
        audit=audit(frames, k, columns=(*AUDIT_COLUMNS, *CONTACT_COLUMNS, *mesh)), resolved=held,
        **verdict(found, frames.force_balance[:, k], frames.reason[:, k]))
