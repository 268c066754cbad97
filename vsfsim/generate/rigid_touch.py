"""The way from planned poses to solved touches by rigid bodies: what a dataset records and what a press shows.

With ``mount_stiffness`` a spring along the press carries the probe. The recorded poses are the mount's, which are as
planned; the probe is where the spring and the contact balance, see `vsfsim.physics.contact.mount`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from vsfsim.core.scene import Scene
from vsfsim.data.records import AUDIT_COLUMNS, CONTACT_COLUMNS, MESH_COLUMNS, Touch
from vsfsim.generate.aim import Aim, starts
from vsfsim.generate.record import batches, recorded
from vsfsim.physics import tiers
from vsfsim.physics.contact.law import contact_law_of
from vsfsim.physics.contact.mount import Mount
from vsfsim.physics.mesh.resolved import resolved
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import body_poses, touch_path

# touches that are solved together, on a CPU as many as share a back-solve; part of what fixes the bits
BATCH = {"cpu": 16, "cuda": 64}


def solve(scene: Scene, model: Model, aims: Sequence[Aim], *, tier: str, device: str,
          options: SolverOptions, keep: bool = False,
          progress: Callable[[int], None] = lambda _: None) -> Iterator[tuple[Solver, Frames, list[Touch]]]:
    """Solve touches, `BATCH` at a time at most; yields the solver, the frames and the records of each batch.

    Args:
        scene: whose rigid bodies touch; with ``[touches]`` where an aim has no path of its own.
        model: the object, at ``tier``.
        aims: the touches.
        device: Warp device.
        options: solver limits.
        keep: as of `Solver.run`.
        progress: called with the number of frames newly done.
    """
    spring, bodies = scene.mount_stiffness, 1 + len(scene.parts)
    for some in batches(len(aims), BATCH[device.split(":")[0]]):
        part = aims[some]
        poses = np.stack([a.path if a.path is not None else
                          touch_path(scene.required_touches, scene.probe, a.contact, a.axis, depth=a.depth,
                                     approach=a.approach) for a in part], axis=1)
        real = poses.copy()
        real[..., :3, 3] += [a.late * a.axis for a in part]
        solver = Solver(model, scene.bodies, friction=scene.frictions, device=device,
                        options=options, linear=not tiers.TIERS[tier].nonlinear, law=contact_law_of(scene))
        width = len(part)
        placed = np.stack([body_poses(scene, real[:, k]) for k in range(width)], axis=1)
        frames = solver.run(placed, start=body_poses(scene, starts(scene, part, poses[0])), keep=keep,
                            mount=None if spring is None else Mount(spring, np.stack([a.axis for a in part])),
                            progress=lambda _, k=width: progress(k))  # type: ignore[misc]
        # obstacles do not belong to the probe
        force = frames.force - frames.body_force[:, :, bodies:].sum(axis=2) if scene.obstacles else frames.force
        yield solver, frames, [_record(a, poses[:, k], force[:, k], frames, k, solver, spring)
                               for k, a in enumerate(part)]


def _record(a: Aim, poses: np.ndarray, force: np.ndarray, frames: Frames, k: int, solver: Solver,
            spring: float | None) -> Touch:
    mesh = MESH_COLUMNS if np.isfinite(frames.mesh_error[:, k]).all() else ()
    held = resolved(frames.mesh_error[:, k], frames.corner_det_f[:, k], solver.linear * frames.rotation[:, k],
                    frames.converged[:, k], solver.model.solid.parts) if mesh else None
    return recorded(frames, k, poses, force, found=np.isfinite(force).all(axis=1), axis=a.axis,
                    target=a.target, normal=a.normal,
                    touched=bool((frames.penetration[:, k] > 0.0).any()), mount_stiffness=spring,
                    resolved=held, columns=(*AUDIT_COLUMNS, *CONTACT_COLUMNS, *mesh))
