"""Touches of plants by an arm: equilibria, joint torques and records; of one view, or of many views together.

One warp of a GPU solves one touch, so the touches of one view alone would leave most of the GPU idle. There CPU
processes prepare and finish views, and one device solves the touches of many views together. The bits of a touch do not
depend on which others it is solved with.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from vsfsim.core.scene import Scene
from vsfsim.data.records import AUDIT_COLUMNS, ObjectView, Touch
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim
from vsfsim.generate.plants.skeleton import displaced
from vsfsim.generate.plants.subject import Subject, beams, prepare_job
from vsfsim.generate.plants.truth import plant_truth
from vsfsim.generate.record import recorded
from vsfsim.generate.workers import enough_memory, process_pool, submit, write
from vsfsim.physics.rods.solver import RodFrames, RodOptions, RodSolver
from vsfsim.robot.arm import Arm, Postures, body_torque, chain_of
from vsfsim.robot.path import times

TOGETHER = 4096  # touches on a device at once, which take 7 GB
FLIPPED = 0.05  # share of a touch's largest torques by which a frame may change if the skeleton is displaced


def make_view(job: Job, *, device: str) -> ObjectView:
    """The object view of a job."""
    subject = prepare_job(job, device=device)
    return finish(subject, solve([subject], device=device), _jittered([subject], device=device), device=device)


def _jittered(subjects: Sequence[Subject], *, device: str) -> RodFrames | None:
    """The same touches of the plants with skeletons displaced by the scene's ``jitter``; None if it asks for none."""
    by = subjects[0].scene.required_arm.jitter
    if not by:
        return None
    plants = [displaced(one.plant, by, np.random.default_rng(one.job.object_index)) for one in subjects]
    return solve([dataclasses.replace(one, plant=plant, model=beams(plant, one.scene))
                  for one, plant in zip(subjects, plants, strict=True)], device=device)


def solve(subjects: Sequence[Subject], *, device: str, progress: Callable[[int], None] = lambda _: None,
          keep_nodes: bool = False) -> RodFrames:
    """The equilibria of the touches of views of one scene, view after view.

    Args:
        subjects: the views.
        device: Warp device.
        progress: called with the number of frames newly done.
        keep_nodes: as of `RodSolver.run`.
    """
    scene = subjects[0].scene
    solver = RodSolver([s.model for s in subjects], subjects[0].loaded_arm().shapes, device=device,
                       options=RodOptions(force_limit=scene.required_touches.force_limit))
    aims = [a for s in subjects for a in s.aims]
    friction = [s.scene.required_object.friction for s in subjects for _ in s.aims]
    return solver.run(np.repeat(np.arange(len(subjects)), [len(s.aims) for s in subjects]),
                      np.concatenate([s.poses for s in subjects], axis=1), plan=np.stack([a.plan for a in aims]),
                      friction=np.array(friction), keep_nodes=keep_nodes, progress=progress)


def make_together(jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
    """Make and write views whose touches are solved together; yields the name of each.

    Args:
        jobs: what to make.
        device: Warp device, of the processes too.
        workers: processes, or None for one a core.
    """
    with process_pool(len(jobs), workers, device=device) as pool:
        prepared = [submit(pool, _prepared, job, device) for job in jobs]
        views = max(1, TOGETHER // jobs[0].scene().required_touches.count)
        writing = []
        for begin in range(0, len(jobs), views):
            some = slice(begin, begin + views)
            subjects = [future.result() for future in prepared[some]]
            with enough_memory(jobs[0].recipe.scene, device):
                frames, other = solve(subjects, device=device), _jittered(subjects, device=device)
            last = np.cumsum([len(s.aims) for s in subjects])
            for job, subject, end in zip(jobs[some], subjects, last, strict=True):
                mine = [one and one.of(slice(end - len(subject.aims), end)) for one in (frames, other)]
                writing.append(submit(pool, _write, job, dataclasses.replace(subject, poses=np.zeros(0)), *mine,
                                      device))
                yield job.name
        for future in writing:
            future.result()


def _prepared(job: Job, device: str) -> Subject:
    """In a process of its own: a view that is ready to be touched, without the arm, whose simulator does not travel."""
    return dataclasses.replace(prepare_job(job, device=device), arm=None)


def _write(job: Job, subject: Subject, frames: RodFrames, other: RodFrames | None, device: str) -> None:
    write(job, finish(subject, frames, other, device=device), device)


def finish(subject: Subject, frames: RodFrames, other: RodFrames | None, *, device: str) -> ObjectView:
    """The object view of a touched subject: records, torques and truth; ``other`` are frames of its displaced plant,
    None if none are asked for."""
    assert subject.view is not None
    touches, chain, job = finish_touches(subject, frames), chain_of(subject.loaded_arm()), subject.job
    if other is not None:
        touches = [dataclasses.replace(touch, resolved=agrees(touch, moved))
                   for touch, moved in zip(touches, finish_touches(subject, other), strict=True)]
    truth = plant_truth(subject.model, subject.view, touches, chain,
                        friction=subject.scene.required_object.friction, device=device)
    return ObjectView(job.name, job.object_index, job.view_index, job.split, chain, subject.view, tuple(touches), truth)


def agrees(touch: Touch, other: Touch) -> np.ndarray:
    """The frames of a touch (T,) bool before the first in which the torques of two touches differ by more than
    `FLIPPED` of its largest; a frame that one of them has not, or without an equilibrium in it, differs."""
    ours, theirs = np.asarray(touch.torque), np.full((len(touch.time), 7), np.nan)
    both = min(len(ours), len(other.time))
    theirs[:both] = np.where(other.converged[:both, None], np.asarray(other.torque)[:both], np.nan)
    size = np.linalg.norm(ours[touch.converged], axis=1).max(initial=0.0)
    near = np.linalg.norm(ours - theirs, axis=1) <= FLIPPED * size
    return np.logical_and.accumulate(near | ~touch.converged)


def finish_touches(subject: Subject, frames: RodFrames) -> list[Touch]:
    """The records and torques of a touched subject."""
    arm = subject.loaded_arm()
    return [_touch(subject.scene, arm, a, frames, b) for b, a in enumerate(subject.aims)]


def _touch(scene: Scene, arm: Arm, a: ArmAim, frames: RodFrames, b: int) -> Touch:
    n = int(frames.frames[b])
    if n < len(a.plan):
        # stopped by the force limit: what did not converge on the way there is no reading either
        good = np.flatnonzero(frames.converged[:n, b])
        n = int(good[-1]) + 1 if len(good) else 1
    # a touch whose first frame is past the limit has one frame, which was not solved
    q = a.line[a.plan[:n]]
    postures = arm.postures(q)
    force, moment = frames.force[:n, b], frames.moment[:n, b]
    torque = body_torque(arm, postures, force, moment=moment)
    link_force, link_moment = _by_link(arm, postures, force, moment)
    return recorded(frames, b, postures.tool, force.sum(axis=1), axis=a.axis, target=a.target, normal=-a.axis,
                    touched=bool((frames.contacts[:n, b] > 0).any()), q=q, torque=torque, link_force=link_force,
                    link_moment=link_moment, draws=a.draws,
                    columns=tuple(name for name in AUDIT_COLUMNS if name != "min_det_f"),  # beams have no det F
                    **(_plan(arm, a, n) if scene.required_touches.plan else {}))


def _plan(arm: Arm, a: ArmAim, made: int) -> dict[str, Any]:
    """The planned path of a touch, of which the first ``made`` frames were made."""
    q = a.line[a.plan]
    return {"planned_time": times(len(a.plan)), "planned_pose": arm.postures(q).tool,
            "planned_q": q, "planned_frame": np.arange(made)}


def _by_link(arm: Arm, at: Postures, force: np.ndarray, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Forces on the links (T, L, 3) [N] and moments about their origins (T, L, 3) [N m]."""
    place = arm.capsule_poses(at)[..., :3, 3] - at.links[:, arm.capsule_links][..., :3, 3]
    about = moment + np.cross(place, force)
    out = np.zeros((2, len(force), len(arm.links), 3))
    for k, link in enumerate(arm.capsule_links):
        out[0, :, link] += force[:, k]
        out[1, :, link] += about[:, k]
    return out[0], out[1]
