"""Many views of plants at once: prepared and finished by CPU processes, while those that are ready are touched together
on one device.

A GPU's warp carries out one touch, so the touches of one view alone would leave it idle: views come in as they are
prepared and go out as they are done. The bits of a touch do not depend on which others it is solved with.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait

import numpy as np

from vsfsim.data.records import ObjectView, View
from vsfsim.generate.job import Job
from vsfsim.generate.plants.aim import ArmAim, load
from vsfsim.generate.plants.prepare import Seconds, Subject, choose, look, outline
from vsfsim.generate.plants.touches import begin, finish, rod_options
from vsfsim.generate.workers import process_pool, write
from vsfsim.physics.rods.solver import GPU_SPAN, RodBatch, RodFrames, RodSolver

PLACES = 4096  # touches on a device at once: 7 GB
SHORT_SPAN = 3.0  # s: a launch on a GPU while touches are still to come
# touches of a view that a process chooses at a time: the first ones are touched soon, and where most targets are out of
# reach no process is held up for long
PART = 17


class _Preparation:
    """Views on their way to be touched: each is looked at by one process, and then aimed at by several, `PART` touches
    at a time.

    outlines: of the views. ready: parts that can be touched: number of the view, of the part, and these touches of the
    view.
    """

    def __init__(self, jobs: Sequence[Job], pool: ProcessPoolExecutor, device: str, spent: Seconds):
        self._jobs, self._pool, self._spent = jobs, pool, spent
        self._looking: dict[Future[tuple[View, np.ndarray, Seconds]],
                            int] = {pool.submit(look_one, job, device): k for k, job in enumerate(jobs)}
        self._aiming: dict[Future[tuple[list[ArmAim], np.ndarray, Seconds]], tuple[int, int]] = {}
        self._views: dict[int, View] = {}
        # while the processes begin
        since = spent.begin()
        self.outlines = [outline(job) for job in jobs]
        spent.charge("grow", since)
        self.ready: list[tuple[int, int, Subject]] = []

    @property
    def going(self) -> bool:
        """Whether parts are still to come."""
        return bool(self._looking or self._aiming)

    def parts(self, k: int) -> int:
        """How many parts view ``k`` has."""
        return -(-self._count(k) // PART)

    def _count(self, k: int) -> int:
        spec = self.outlines[k].scene.touches
        assert spec is not None
        return spec.count

    def gather(self, timeout: float) -> int:
        """Waits ``timeout`` [s] at most for something new; how many touches are newly ready."""
        there, _ = wait([*self._looking, *self._aiming], timeout=timeout, return_when=FIRST_COMPLETED)
        before = len(self.ready)
        for future in there:
            if future in self._looking:
                k = self._looking.pop(future)
                self._views[k], cloud, took = future.result()
                for part in range(self.parts(k)):
                    numbers = range(part * PART, min((part + 1) * PART, self._count(k)))
                    self._aiming[self._pool.submit(aim_one, self._jobs[k], cloud, numbers)] = k, part
            else:
                k, part = self._aiming.pop(future)
                aims, poses, took = future.result()
                o = self.outlines[k]
                self.ready.append((k, part, Subject(o.job, o.scene, o.plant, o.model, self._views[k], aims, poses)))
            self._spent.add(took)
        return sum(len(s.aims) for *_, s in self.ready[before:])

    def cancel(self) -> None:
        """No more parts are wanted."""
        for future in (*self._looking, *self._aiming):
            future.cancel()


def touched(jobs: Sequence[Job], pool: ProcessPoolExecutor, *, device: str, spent: Seconds, until: float | None = None,
            watch: Callable[[str, int, int], None] | None = None) -> Iterator[tuple[int, Subject, RodFrames]]:
    """Number, subject and frames of the views of ``jobs``, in the order in which they are done.

    Args:
        pool: processes that prepare. spent: where the time of all processes is charged. until: on the clock
        (`time.perf_counter`) when no launch is begun any more; touches under way then come as far as they are, others
        not at all.
        watch: called with what happened, "prepared" or "solved", how many touches or frames newly did, and touches that
        go on.
    """
    coming = _Preparation(jobs, pool, device, spent)
    since = spent.begin()
    scene = coming.outlines[0].scene
    assert scene.arm is not None and scene.touches is not None
    free, inward, hold, out = scene.touches.frames
    solver = RodSolver([o.model for o in coming.outlines], load(scene.arm).shapes, device=device,
                       options=rod_options(scene))
    batch = RodBatch(solver, min(max(PLACES, PART), scene.touches.count * len(jobs)),
                     frames=free + inward + hold + out, poses=inward + 1)
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
            k, part, subject = coming.ready.pop(0)
            inside[k, part] = _lean(subject), begin(batch, subject, k)
        if batch.live:
            new = batch.advance(seconds=min(SHORT_SPAN if coming.going or coming.ready else GPU_SPAN, left))
            if watch is not None:
                watch("solved", new, batch.live)
        for k, part in [key for key, (_, some) in inside.items() if batch.done(some)]:
            subject, some = inside.pop((k, part))
            done.setdefault(k, {})[part] = subject, batch.take(some)
        spent.charge("solve", since)
        for k in [k for k, parts in done.items() if len(parts) == coming.parts(k)]:
            yield k, *_joined(done.pop(k))
    coming.cancel()
    for (k, part), (subject, some) in inside.items():
        done.setdefault(k, {})[part] = subject, batch.take(some)
    for k, parts in done.items():
        yield k, *_joined(parts)


def _joined(parts: dict[int, tuple[Subject, RodFrames]]) -> tuple[Subject, RodFrames]:
    """A view of its parts."""
    subjects, frames = zip(*(parts[number] for number in sorted(parts)), strict=True)
    return dataclasses.replace(subjects[0], aims=[a for s in subjects for a in s.aims]), RodFrames.joined(frames)


def _lean(subject: Subject) -> Subject:
    """Without what is not needed any more when it travels."""
    return dataclasses.replace(subject, arm=None, poses=np.zeros((0, 0, 0, 4, 4)))


def make_together(jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
    """Makes and writes the views of ``jobs``; yields the number of frames newly done and a name.

    Args:
        device: Warp device, of the processes too. workers: processes, None for one a core.
    """
    with process_pool(len(jobs), workers) as pool:
        writing: list[Future[None]] = []
        for k, subject, frames in touched(jobs, pool, device=device, spent=Seconds()):
            writing.append(pool.submit(_write, jobs[k], subject, frames, device))
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
    """In a process of its own: some touches of a view, the poses along their lines, and where the time went. The arm
    holds a simulator, which does not travel."""
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
    write(job, finish(subject, frames, device=device))
