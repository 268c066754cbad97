"""Many views of plants at once: CPU processes prepare and finish them, and one device solves the touches of all that
are ready together.

One warp of a GPU solves one touch, so the touches of one view alone would leave most of the GPU idle. Views enter the
batch when they are prepared and leave it when they are done. The bits of a touch do not depend on which others it is
solved with.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Any

import numpy as np

from vsfsim.data.records import View
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim, load
from vsfsim.generate.plants.prepare import Subject, choose, look, outline
from vsfsim.generate.plants.touches import begin, finish, rod_options
from vsfsim.generate.workers import largest, process_pool, submit, write
from vsfsim.physics.rods.solver import GPU_SPAN, RodBatch, RodFrames, RodSolver

PLACES = 4096  # touches on a device at once, which take 7 GB
SHORT_SPAN = 3.0  # duration of a launch on a GPU while more touches are being prepared [s]
PART = 17  # touches that a process aims at a time; a view's first touches are then ready before its last ones are aimed


class _Preparation:
    """Views that are being prepared: one process takes the picture of a view, then several aim its touches, `part`
    touches at a time."""

    outlines: list[Subject]
    """The plants of the views."""
    ready: list[tuple[int, int, Subject]]
    """Parts of views that can be touched: number of the view, number of the part, and its touches."""

    def __init__(self, jobs: Sequence[Job], pool: ProcessPoolExecutor, device: str, part: int):
        self._jobs, self._pool, self._part = jobs, pool, part
        self._going: dict[Future[Any], tuple[int, int | None]] = {
            submit(pool, look_one, job, device): (k, None) for k, job in enumerate(jobs)}
        self._views: dict[int, View] = {}
        self.outlines = [outline(job) for job in jobs]  # the processes start meanwhile
        self.ready = []

    @property
    def going(self) -> bool:
        """Whether parts are still to come."""
        return bool(self._going)

    def parts(self, k: int) -> list[range]:
        """The touches of each part of view ``k``."""
        count = self.outlines[k].scene.required_touches.count
        return [range(start, min(start + self._part, count)) for start in range(0, count, self._part)]

    def gather(self, timeout: float) -> None:
        """Wait at most ``timeout`` [s] for a process to finish something."""
        for future in wait(list(self._going), timeout=timeout, return_when=FIRST_COMPLETED)[0]:
            k, part = self._going.pop(future)
            if part is None:
                self._views[k], cloud = future.result()
                for number, touches in enumerate(self.parts(k)):
                    self._going[submit(self._pool, aim_one, self._jobs[k], cloud, touches)] = k, number
            else:
                aims, poses = future.result()
                self.ready.append((k, part, dataclasses.replace(self.outlines[k], view=self._views[k], aims=aims,
                                                                poses=poses)))


def touched(jobs: Sequence[Job], pool: ProcessPoolExecutor, *, device: str,
            part: int = PART) -> Iterator[tuple[int, Subject, RodFrames]]:
    """Number, subject and frames of the views of ``jobs``, in the order in which they are done.

    Args:
        jobs: the views.
        pool: processes that prepare them.
        device: Warp device.
        part: touches that a process aims at a time.
    """
    coming = _Preparation(jobs, pool, device, part)
    scene = coming.outlines[0].scene
    spec = scene.required_touches
    free, inward, hold, out = spec.frames
    solver = RodSolver([o.model for o in coming.outlines], load(scene.required_arm).shapes, device=device,
                       options=rod_options(scene))
    batch = largest(lambda places: RodBatch(solver, places, frames=free + inward + hold + out, poses=inward + 1),
                    min(max(PLACES, part), spec.count * len(jobs)), min(part, spec.count), jobs[0].recipe.scene, device)
    inside: dict[tuple[int, int], tuple[Subject, slice]] = {}
    done: dict[int, dict[int, tuple[Subject, RodFrames]]] = {}
    while coming.going or coming.ready or inside:
        coming.gather(0.0 if batch.live else 2.0)
        while coming.ready and batch.room(len(coming.ready[0][2].aims)):
            k, number, subject = coming.ready.pop(0)
            # without the poses, which are not needed when it is sent to another process
            inside[k, number] = dataclasses.replace(subject, poses=np.zeros(0)), begin(batch, subject, k)
        if batch.live:
            batch.advance(seconds=SHORT_SPAN if coming.going or coming.ready else GPU_SPAN)
        for k, number in [key for key, (_, some) in inside.items() if batch.done(some)]:
            subject, some = inside.pop((k, number))
            done.setdefault(k, {})[number] = subject, batch.take(some)
        for k in [k for k, parts in done.items() if len(parts) == len(coming.parts(k))]:
            own = done.pop(k)
            subjects, frames = zip(*(own[number] for number in sorted(own)), strict=True)
            yield (k, dataclasses.replace(subjects[0], aims=tuple(a for s in subjects for a in s.aims)),
                   RodFrames.joined(frames))


def make_together(jobs: Sequence[Job], *, device: str, workers: int | None,
                  part: int = PART) -> Iterator[str]:
    """Make and write views whose touches are solved together; yields the name of each as they come.

    Args:
        jobs: what to make.
        device: Warp device, of the processes too.
        workers: processes, or None for one a core.
        part: touches that a process aims at a time.
    """
    with process_pool(len(jobs), workers, device=device) as pool:
        writing: list[Future[None]] = []
        for k, subject, frames in touched(jobs, pool, device=device, part=part):
            writing.append(submit(pool, _write, jobs[k], subject, frames, device))
            yield jobs[k].name
        for future in writing:
            future.result()


def look_one(job: Job, device: str) -> tuple[View, np.ndarray]:
    """In a process of its own: the picture of a view and its cloud (n, 3) [m]."""
    view = look(outline(job), device=device)
    return view, view.points()


def aim_one(job: Job, cloud: np.ndarray, numbers: range) -> tuple[tuple[ArmAim, ...], np.ndarray]:
    """In a process of its own: some touches of a view, and the poses along their lines. The arm is not returned,
    because its simulator cannot be sent to another process."""
    chosen = choose(outline(job), cloud, numbers)
    return chosen.aims, chosen.poses


def _write(job: Job, subject: Subject, frames: RodFrames, device: str) -> None:
    write(job, finish(subject, frames, device=device), device)
