"""Many views of plants at once: CPU processes prepare and finish them, and one device solves the touches of all that
are ready together.

One warp of a GPU solves one touch, so the touches of one view alone would leave most of the GPU idle. Views enter the
batch when they are prepared and leave it when they are done. The bits of a touch do not depend on which others it is
solved with.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from typing import Any

import numpy as np

from vsfsim.data.records import ObjectView, View
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim, load
from vsfsim.generate.plants.prepare import Outline, Seconds, Subject, choose, look, outline
from vsfsim.generate.plants.touches import begin, finish, rod_options
from vsfsim.generate.workers import largest, process_pool, submit, write
from vsfsim.physics.rods.solver import GPU_SPAN, RodBatch, RodFrames, RodSolver

PLACES = 4096  # touches on a device at once, which take 7 GB
SHORT_SPAN = 3.0  # duration of a launch on a GPU while more touches are being prepared [s]
PART = 17  # touches that a process aims at a time; a view's first touches are then ready before its last ones are aimed


class _Preparation:
    """Views that are being prepared: one process takes the picture of a view, then several aim its touches, `part`
    touches at a time."""

    outlines: list[Outline]
    """The plants of the views."""
    ready: list[tuple[int, int, Subject]]
    """Parts of views that can be touched: number of the view, number of the part, and its touches."""

    def __init__(self, jobs: Sequence[Job], pool: ProcessPoolExecutor, device: str, spent: Seconds, part: int):
        self._jobs, self._pool, self._spent, self._part = jobs, pool, spent, part
        self._looking: dict[Future[tuple[View, np.ndarray, Seconds]], int] = {
            submit(pool, look_one, job, device): k for k, job in enumerate(jobs)}
        self._aiming: dict[Future[tuple[list[ArmAim], np.ndarray, Seconds]], tuple[int, int]] = {}
        self._views: dict[int, View] = {}
        since = spent.begin()  # the processes start meanwhile
        self.outlines = [outline(job) for job in jobs]
        spent.charge("grow", since)
        self.ready = []

    @property
    def going(self) -> bool:
        """Whether parts are still to come."""
        return bool(self._looking or self._aiming)

    def parts(self, k: int) -> int:
        """How many parts view ``k`` has."""
        return -(-self._count(k) // self._part)

    def _count(self, k: int) -> int:
        return self.outlines[k].scene.required_touches.count

    def gather(self, timeout: float) -> int:
        """Wait at most ``timeout`` [s] for a process to finish something.

        Returns:
            The number of touches newly ready.
        """
        going: list[Future[Any]] = [*self._looking, *self._aiming]
        there, _ = wait(going, timeout=timeout, return_when=FIRST_COMPLETED)
        before = len(self.ready)
        for future in there:
            if future in self._looking:
                k = self._looking.pop(future)
                self._views[k], cloud, took = future.result()
                for part in range(self.parts(k)):
                    numbers = range(part * self._part, min((part + 1) * self._part, self._count(k)))
                    self._aiming[submit(self._pool, aim_one, self._jobs[k], cloud, numbers)] = k, part
            else:
                k, part = self._aiming.pop(future)
                aims, poses, took = future.result()
                o = self.outlines[k]
                self.ready.append((k, part, Subject(o.job, o.scene, o.plant, o.model, self._views[k], aims, poses,
                                                   o.notes)))
            self._spent.add(took)
        return sum(len(s.aims) for *_, s in self.ready[before:])

    def cancel(self) -> None:
        """Call off what no process has begun."""
        going: list[Future[Any]] = [*self._looking, *self._aiming]
        for future in going:
            future.cancel()


def touched(jobs: Sequence[Job], pool: ProcessPoolExecutor, *, device: str, spent: Seconds, until: float | None = None,
            watch: Callable[[str, int, int], None] | None = None,
            part: int = PART) -> Iterator[tuple[int, Subject, RodFrames]]:
    """Number, subject and frames of the views of ``jobs``, in the order in which they are done.

    Args:
        jobs: the views.
        pool: processes that prepare them.
        device: Warp device.
        spent: where the time of all processes is charged.
        until: time of `time.perf_counter` after which no launch is begun; touches under way then are cut where they
            are, and others are left out.
        watch: called with what happened, "prepared" or "solved", to how many touches or frames, and how many touches
            go on.
        part: touches that a process aims at a time.
    """
    coming = _Preparation(jobs, pool, device, spent, part)
    since = spent.begin()
    scene = coming.outlines[0].scene
    spec = scene.required_touches
    free, inward, hold, out = spec.frames
    solver = RodSolver([o.model for o in coming.outlines], load(scene.required_arm).shapes, device=device,
                       options=rod_options(scene))
    batch = largest(lambda places: RodBatch(solver, places, frames=free + inward + hold + out, poses=inward + 1),
                    min(max(PLACES, part), spec.count * len(jobs)), min(part, spec.count), jobs[0].recipe.scene, device)
    spent.charge("solve", since)
    inside: dict[tuple[int, int], tuple[Subject, slice]] = {}
    done: dict[int, dict[int, tuple[Subject, RodFrames]]] = {}
    while coming.going or coming.ready or inside:
        left = np.inf if until is None else until - time.perf_counter()
        if left <= 0.0:
            break
        new = coming.gather(0.0 if batch.live else min(left, 2.0))
        if new and watch is not None:
            watch("prepared", new, batch.live)
        since = spent.begin()
        while coming.ready and batch.room(len(coming.ready[0][2].aims)):
            k, number, subject = coming.ready.pop(0)
            inside[k, number] = _lean(subject), begin(batch, subject, k)
        if batch.live:
            new = batch.advance(seconds=min(SHORT_SPAN if coming.going or coming.ready else GPU_SPAN, left))
            if watch is not None:
                watch("solved", new, batch.live)
        for k, number in [key for key, (_, some) in inside.items() if batch.done(some)]:
            subject, some = inside.pop((k, number))
            done.setdefault(k, {})[number] = subject, batch.take(some)
        spent.charge("solve", since)
        for k in [k for k, parts in done.items() if len(parts) == coming.parts(k)]:
            yield k, *_joined(done.pop(k))
    coming.cancel()
    for (k, number), (subject, some) in inside.items():
        done.setdefault(k, {})[number] = subject, batch.take(some)
    for k, parts in done.items():
        yield k, *_joined(parts)


def _joined(parts: dict[int, tuple[Subject, RodFrames]]) -> tuple[Subject, RodFrames]:
    """A view, put together from its parts."""
    subjects, frames = zip(*(parts[number] for number in sorted(parts)), strict=True)
    return dataclasses.replace(subjects[0], aims=[a for s in subjects for a in s.aims]), RodFrames.joined(frames)


def _lean(subject: Subject) -> Subject:
    """The subject without the arm and the poses, which are not needed when it is sent to another process."""
    return dataclasses.replace(subject, arm=None, poses=np.zeros((0, 0, 0, 4, 4)))


def make_together(jobs: Sequence[Job], *, device: str, workers: int | None,
                  part: int = PART) -> Iterator[tuple[int, str]]:
    """Make and write views whose touches are solved together; yields (frames newly done, name) as they come.

    Args:
        jobs: what to make.
        device: Warp device, of the processes too.
        workers: processes, or None for one a core.
        part: touches that a process aims at a time.
    """
    with process_pool(len(jobs), workers, device=device) as pool:
        writing: list[Future[None]] = []
        for k, subject, frames in touched(jobs, pool, device=device, spent=Seconds(), part=part):
            writing.append(submit(pool, _write, jobs[k], subject, frames, device))
            yield sum(len(a.plan) for a in subject.aims), jobs[k].name
        for future in writing:
            future.result()


def look_one(job: Job, device: str) -> tuple[View, np.ndarray, Seconds]:
    """In a process of its own: the picture of a view, its cloud (n, 3) [m], and where the time went."""
    seconds = Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    view = look(o, device=device, seconds=seconds)
    return view, view.points(), seconds


def aim_one(job: Job, cloud: np.ndarray, numbers: range) -> tuple[list[ArmAim], np.ndarray, Seconds]:
    """In a process of its own: some touches of a view, the poses along their lines, and where the time went. The arm is
    not returned, because its simulator cannot be sent to another process."""
    seconds = Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    _, aims, poses = choose(o, cloud, numbers, seconds=seconds)
    return aims, poses, seconds


def finish_one(subject: Subject, frames: RodFrames, device: str) -> tuple[ObjectView, Seconds]:
    """In a process of its own: the records of a touched view, and where the time went."""
    seconds = Seconds()
    return finish(subject, frames, device=device, seconds=seconds), seconds


def _write(job: Job, subject: Subject, frames: RodFrames, device: str) -> None:
    write(job, finish(subject, frames, device=device), device)
