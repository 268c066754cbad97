"""Processes that make object views, each with one thread: the bits do not depend on how many there are."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.engines import one_thread
from vsfsim.data.disk import Store
from vsfsim.data.lines import MOST_FAILURES, Failure, check_kind, failure, finished_names, put_failure, put_view
from vsfsim.data.manifest import Entry
from vsfsim.data.provenance import machine_kind
from vsfsim.data.records import ObjectView
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import Job
from vsfsim.generate.recipe import check_files

_PRELOAD = ("h5py", "scipy.ndimage", "scipy.sparse.csgraph", "scipy.sparse.linalg",
            "scipy.spatial.transform", "torch", "trimesh", "warp")
"""What every worker imports, in 2.6 s of a core. No module of vsfsim: some start Warp, which opens a GPU's driver, and
no fork survives that."""
_ON_A_GPU, _ROOM = 16, 5 * 2**30
"""Processes that share a GPU, at most, and its memory that each has [byte]. A process waits for its host most of the
time: one keeps an H200 busy 24 % of it. A shoe of 20,000 unknowns takes 3 GiB, and twice that for a moment, in turn."""
ENDED = ("a worker process ended before its {} was finished, as one does that is killed or out of memory. Run the same "
         "command again, which makes only what is missing; with fewer --workers it needs less memory.")
_LONGEST_FOLDER = 60
"""Of temporary files; the address of a socket has 108 characters."""


def _processes(device: str) -> Any:
    """How workers begin: on a CPU as forks of a server that has imported `_PRELOAD` and does nothing else, where the
    system has that, and anew otherwise. Never as forks of this process, whose threads and GPU they could not use."""
    if (device != "cpu" or "forkserver" not in multiprocessing.get_all_start_methods()
            or len(tempfile.gettempdir()) > _LONGEST_FOLDER):
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_PRELOAD))
    return context


@contextlib.contextmanager
def process_pool(jobs: int, workers: int | None, *, device: str = "cpu") -> Iterator[ProcessPoolExecutor]:
    """New processes of one thread each, ``workers`` of them (None: one for every core), and no more than ``jobs``.

    ``device`` is the one that they will use.
    """
    with one_thread():
        pool = ProcessPoolExecutor(max(1, min(workers or os.cpu_count() or 1, jobs)),
                                   mp_context=_processes(device), initializer=_set_up,
                                   initargs=(dict(os.environ),))
        before_us = set(multiprocessing.active_children())
        try:
            yield pool
        except KeyboardInterrupt:
            for process in set(multiprocessing.active_children()) - before_us:
                process.terminate()  # a view can take minutes, and what is not finished is made again
            raise
        finally:
            pool.shutdown(cancel_futures=True)


def submit(pool: ProcessPoolExecutor, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """``pool.submit``, whose new process does not run the user's script again.

    A new process imports the file that Python was started with. Without ``if __name__ == "__main__"`` that file
    would make the dataset once more. Our workers need modules of vsfsim alone.
    """
    script = sys.modules["__main__"]
    hidden: dict[str, Any] = {name: vars(script).pop(name) for name in ("__file__", "__spec__") if name in vars(script)}
    script.__spec__ = None
    try:
        return pool.submit(function, *arguments)
    finally:
        vars(script).update(hidden)


def make_each(jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
    """Make and write views, each in one process from the start to the end; yields the name of each as they come.

    If a process dies and a run allows ``poison``, those that were under way are made again one by one, so
    that only the one that kills its process is blamed.

    Args:
        jobs: what to make.
        device: Warp device.
        workers: processes, or None for one a core on a CPU, and on a GPU for as many as keep it busy, 16 at most.

    Raises:
        VsfsimError: of the first view that fails; the others are then cancelled.
    """
    left = list(jobs)
    while left:
        try:
            for job, _ in in_pool(make_one, left, device, device=device, workers=workers):
                yield job.name
            return
        except BrokenProcessPool as error:
            if "poison" not in jobs[0].allow:
                raise DatasetError(ENDED.format("object view")) from error
        store = Store(jobs[0].store)
        done = finished_names(store)
        left = [job for job in left if job.name not in done]
        begun = [job for job in left if failure(store, job.name).count]
        for job in begun:
            while job.name not in finished_names(store) and failure(store, job.name).count < MOST_FAILURES:
                with contextlib.suppress(BrokenProcessPool):
                    yield from (one.name for one, _ in in_pool(make_one, [job], device, device=device, workers=1))
        left = [job for job in left if job not in begun]


def sharing(device: str) -> int:
    """How many processes share a GPU."""
    import warp

    return max(1, min(_ON_A_GPU, os.cpu_count() or 1, warp.get_device(device).total_memory // _ROOM))


def in_pool(function: Callable[..., Any], jobs: Sequence[Any], *arguments: Any, device: str,
            workers: int | None) -> Iterator[tuple[Any, Any]]:
    """Each job with what ``function`` made of it in one process, as they come; the rest as of `make_each`.

    Raises:
        BrokenProcessPool: a process was killed, or none could be started.
    """
    workers = workers or (None if device == "cpu" else sharing(device))
    with process_pool(len(jobs), workers, device=device) as pool:
        try:
            futures = {submit(pool, function, job, *arguments): job for job in jobs}
        except (EOFError, ConnectionError) as error:  # the server that forks the workers was killed
            raise BrokenProcessPool("no worker could be started") from error
        for future in as_completed(futures):
            yield futures[future], future.result()


def make_one(job: Job, device: str) -> None:
    """Make one view here and write it: what every engine does, in whatever process.

    Where ``poison`` is allowed an attempt is written down before it begins, so that one that kills its process is known
    too; a view that has failed `MOST_FAILURES` times is left.

    Args:
        job: what to make. device: Warp device.

    Raises:
        VsfsimError: the view cannot be made, and ``poison`` is not allowed; or the machine is of another
            kind than the one that began.
    """
    store = Store(job.store)
    check_kind(store, kind_of(device), mixed="mixed" in job.allow)
    if "poison" not in job.allow:
        _make(job, device)
        return
    while (before := failure(store, job.name)).count < MOST_FAILURES:
        put_failure(store, job.name, Failure(before.count + 1, "its process died"))
        try:
            _make(job, device)
            put_failure(store, job.name, Failure(0, ""))
            return
        except Exception as error:
            put_failure(store, job.name, Failure(before.count + 1, f"{type(error).__name__}: {error}"))
        except BaseException:  # stopped by the user or the scheduler, which is no fault of the view
            put_failure(store, job.name, before)
            raise


def _make(job: Job, device: str) -> None:
    with enough_memory(job.name, device):
        write(job, effector_of(job.scene()).make_view(job, device=device), device)


@contextlib.contextmanager
def enough_memory(what: str, device: str) -> Iterator[None]:
    """Raises:
        DatasetError: the memory of a device did not suffice for the block; with what a user can do about it.
    """
    try:
        yield
    except RuntimeError as error:
        if "out of memory" not in str(error).lower():
            raise
        raise DatasetError(f"{what}: the memory of {device} does not suffice for its touches. Give "
                           "fewer --touches, a coarser --tier, fewer --workers on this device, or "
                           "--device cpu.") from None


def kind_of(device: str) -> str:
    """The kind of machine that makes views on a Warp device."""
    if device == "cpu":
        return machine_kind()
    import warp

    return machine_kind(warp.get_device(device).name)


def write(job: Job, view: ObjectView, device: str) -> Entry:
    """Store a view as its job's file, and its line, which is returned.

    Raises:
        DatasetError: the effector left out a channel that it declares, or a field does not fit the schema.
    """
    scene = job.scene()
    for index, touch in enumerate(view.touches):
        for name in effector_of(scene).channels(scene):
            if touch.channel(name) is None:
                raise DatasetError(f"{job.name} touches/{index:03d}: the effector '{scene.effector}' declares the "
                                   f"channel '{name}' and did not record it.")
    check_files(job.recipe, job.path)
    return put_view(Store(job.store), view, job.recipe, kind_of(device))


# ---------------------------------------------------------------------------------------------- in a worker

def _set_up(environment: dict[str, str]) -> None:
    """The environment of the process that asks, which may have changed since the server began."""
    os.environ.clear()
    os.environ.update(environment)
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches every process of a terminal: end without a traceback
    parent = multiprocessing.parent_process()
    if parent is not None:
        # a worker whose parent was killed must not go on writing beside the next run
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: multiprocessing.process.BaseProcess) -> None:
    parent.join()
    os._exit(1)
