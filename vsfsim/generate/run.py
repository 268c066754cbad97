"""From a scene file to a dataset: every object view is one job, done by any worker with the same bits."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile, parse_scene
from vsfsim.core.solid import Solid
from vsfsim.data.dataset import Dataset
from vsfsim.data.hdf5 import write_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.writer import DatasetWriter
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.kernels import pair_kernels, solver_kernels

BATCH = 9  # touches that advance together; part of what fixes the bits
_SCENE, _BODY, _AIM = range(3)  # random streams: SeedSequence(seed, spawn_key=(stream, object, view, touch))


@dataclass(frozen=True)
class Job:
    """One object view to make.

    recipe: of the dataset. path: of the scene file (mesh paths are relative to it). name, split: of the view.
    object_index, view_index: from 0. file: where it goes. cache: folder of filled meshes.
    """

    recipe: Recipe
    path: Path
    name: str
    split: str
    object_index: int
    view_index: int
    file: Path
    cache: Path | None


def stream(seed: int, *key: int) -> np.random.SeedSequence:
    """The random stream ``key`` = (kind, object, view, touch) of a dataset."""
    return np.random.SeedSequence(seed, spawn_key=key)


def splits_for(scene: Scene, objects: int) -> dict[str, int]:
    """Objects of each split: the scene's own numbers, or in its proportions (largest remainders) for another count."""
    given = scene.dataset.splits if scene.dataset else {"test": objects}
    total = sum(given.values())
    if total == objects:
        return dict(given)
    exact = {name: objects * n / total for name, n in given.items()}
    out = {name: int(value) for name, value in exact.items()}
    for name in sorted(exact, key=lambda n: (out[n] - exact[n], list(exact).index(n)))[: objects - sum(out.values())]:
        out[name] += 1
    return out


def make_recipe(scene_file: SceneFile, *, seed: int, objects: int | None, views: int | None, touches: int | None,
                tier: str | None, device: str, precision: str, renderer: str, arm: str | None = None) -> Recipe:
    """What will be made; None takes the scene's own number, or its own arm.

    Raises:
        SceneError: the scene has no ``[touches]``, or the tier does not do.
    """
    from vsfsim.physics import tiers

    scene = scene_file.sample(0)
    if scene.touches is None:
        raise SceneError(f"{scene_file.path}: there is no [touches]; a dataset needs count, depth and frames of "
                         f"its touches.")
    if scene.arm is None and arm is not None:
        raise SceneError(f"{scene_file.path}: --arm is '{arm}', but the scene has no [arm]; it is touched "
                         f"by a [probe].")
    if scene.arm is not None and (tier or "rod") not in ("rod", "auto"):
        raise SceneError(f"{scene_file.path}: --tier is '{tier}', but what an arm touches is made of beams, "
                         f"tier 'rod'.")
    if scene.arm is not None and precision != "float64":
        raise SceneError(f"{scene_file.path}: --precision is '{precision}', but beams are solved in float64 only.")
    if scene.sensor is not None:
        from vsfsim.generate.effectors.bubble import check, tier_for

        chosen = tier_for(scene, tier)
        check(scene, precision)
    else:
        chosen = "rod" if scene.arm is not None else tiers.choose(scene, tier)
    count = objects if objects is not None else (scene.dataset.objects if scene.dataset else 1)
    for name, value in (("--objects", count), ("--views", views), ("--touches", touches), ("--seed + 1", seed + 1)):
        if value is not None and value < 1:
            raise SceneError(f"{name} is {value}; it must be at least 1.")
    return Recipe(
        scene=scene_file.name, scene_text=scene_file.text, seed=seed, objects=count,
        views=views if views is not None else (scene.dataset.views if scene.dataset else 1),
        touches=touches if touches is not None else scene.touches.count, splits=splits_for(scene, count),
        device=device.split(":")[0], tier=chosen, precision=precision, renderer=renderer,
        options={} if arm is None else {"arm": arm})


def jobs_of(recipe: Recipe, path: Path, writer: DatasetWriter | None, folder: Path, cache: Path | None) -> list[Job]:
    """One job for every object view, in order."""
    split_of = [name for name, n in recipe.splits.items() for _ in range(n)]
    out = []
    for o in range(recipe.objects):
        for v in range(recipe.views):
            name = f"{recipe.scene}-{o:04d}-v{v}"
            file = writer.file_of(name) if writer is not None else folder / f"{name}.h5"
            out.append(Job(recipe, path, name, split_of[o], o, v, file, cache))
    return out


def make_view(job: Job, *, device: str, progress: Callable[[int], None] | None = None) -> ObjectView:
    """Build the object, look at it, touch it, and say the truth.

    Args:
        job: what. device: Warp device. progress: called with the number of frames newly done.
    """
    from vsfsim.generate.effectors.probe import aim, touch_all
    from vsfsim.generate.truth import truth_of
    from vsfsim.physics import tiers
    from vsfsim.sensing.camera import look_at, render

    r = job.recipe
    scene = parse_scene(r.scene_text, job.path).sample(stream(r.seed, _SCENE, job.object_index))
    if scene.arm is not None:
        from vsfsim.generate.effectors.arm import make_views

        return make_views([job], device=device, progress=progress)[0]
    assert scene.touches is not None
    spec = dataclasses.replace(scene.touches, count=r.touches)
    model = tiers.build(scene, r.tier, seed=stream(r.seed, _BODY, job.object_index), cache=job.cache)
    camera = dataclasses.replace(scene.camera, azimuth=scene.camera.azimuth + 2.0 * np.pi * job.view_index / r.views)
    low, high = model.mesh.points.min(axis=0), model.mesh.points.max(axis=0)
    intrinsics, pose = look_at(camera, 0.5 * (low + high))
    view = render(surface_of(model.solid, scene), intrinsics, pose, camera.width, camera.height, device=device,
                  renderer=r.renderer)

    def draws(k: int) -> np.random.Generator:
        return np.random.default_rng(stream(r.seed, _AIM, job.object_index, job.view_index, k))

    if scene.sensor is not None:
        from vsfsim.generate.effectors import bubble as touch_bubble
        from vsfsim.physics.bubble.sensor import build_bubble

        sensor = build_bubble(scene.sensor, where=f"{scene.source} [sensor]", cache=job.cache)
        touches = touch_bubble.touch_all(scene, spec, model, sensor,
                                         touch_bubble.aim(scene, spec, model, sensor, view, draws),
                                         options=touch_bubble.options(r.tier, device), device=device, progress=progress)
        dome = touch_bubble.dome_of(sensor)
        truth = truth_of(model, view, touches, dome, friction=float("inf"), device=device)
        return ObjectView(job.name, job.object_index, job.view_index, job.split, dome, view, tuple(touches), truth)
    aims = aim(scene, spec, model, view, draws, device=device)
    batch = -(-len(aims) // -(-len(aims) // BATCH))  # as even as can be
    touches = touch_all(scene, spec, model, aims, options=tiers.options(r.tier),
                        linear=not tiers.TIERS[r.tier].nonlinear,
                        device=device, precision=r.precision, batch=batch, progress=progress)
    truth = truth_of(model, view, touches, scene.probe, friction=scene.object.friction, device=device)
    return ObjectView(job.name, job.object_index, job.view_index, job.split, scene.probe, view, tuple(touches), truth)


def surface_of(solid: Solid, scene: Scene) -> Any:
    """The body's boundary at rest as the cameras take it: a `sensing.surface.Surface`."""
    from vsfsim.physics.tiers import placement
    from vsfsim.sensing.surface import Surface

    turn, shift = placement(scene.object)
    triangles, owner = solid.surface()
    return Surface(solid.vertices @ turn.T + shift, triangles, np.asarray(solid.region)[owner], solid.appearance,
                   solid.vertices)


def generate(scene_file: SceneFile, out: Path, *, seed: int = 0, objects: int | None = None, views: int | None = None,
             touches: int | None = None, tier: str | None = None, device: str = "cpu", precision: str = "float64",
             renderer: str = "warp", workers: int | None = None, cache: Path | None = None, arm: str | None = None,
             progress: Callable[[int, int, str], None] | None = None,
             note: Callable[[str], None] | None = None) -> Dataset:
    """Make a dataset, or finish one that was begun.

    Args:
        scene_file: with ``[touches]``. out: the folder. seed: root of all random streams, 0 or more.
        objects, views, touches: counts, None for the scene's own. tier: fidelity. device: Warp device. precision: of
        the solver. renderer: "warp" or "pyrender". workers: processes (None: one a CPU core; 1 on a GPU).
        arm: model that touches instead of the scene's own. progress: called with (frames done, frames in all, what).
        note: called with sentences for the user.

    Raises:
        SceneError, MeshError, DatasetError: with what to do.
    """
    recipe = make_recipe(scene_file, seed=seed, objects=objects, views=views, touches=touches, tier=tier, device=device,
                         precision=precision, renderer=renderer, arm=arm)
    names = [job.name for job in jobs_of(recipe, scene_file.path, None, out, cache)]
    per_touch = sum(_touches(scene_file).frames)
    with DatasetWriter(out, recipe, names) as writer:
        missing = set(writer.missing())
        jobs = [job for job in jobs_of(recipe, scene_file.path, writer, out, cache) if job.name in missing]
        if note is not None:
            for sentence in writer.notes:
                note(sentence)
        total = len(jobs) * recipe.touches * per_touch
        done = 0
        count = workers if workers is not None else (1 if device != "cpu" else (os.cpu_count() or 1))
        if jobs:
            compile_kernels(_kernels(recipe.precision, scene_file.sample(0)), device, progress=progress)
            if recipe.tier == "rod" and device != "cpu":
                from vsfsim.generate.plants.batches import make_all

                work = make_all(jobs, device=device, workers=workers)
            else:
                work = _work(jobs, min(count, len(jobs)), device)
            for frames, what in work:
                done += frames
                if progress is not None:
                    progress(done, total, what)
        return writer.finish()


def _kernels(precision: str, scene: Scene) -> list[Any]:
    import warp as wp

    from vsfsim.sensing import render_warp
    from vsfsim.vsf import particles
    from vsfsim.vsf.stick_slip import stick_slip_kernel

    if scene.arm is not None:
        from vsfsim.physics.rods.kernels.advance import advance
        from vsfsim.physics.rods.memory import enter

        return [advance, enter, render_warp._cast, particles._behind, stick_slip_kernel(wp.float64)[0]]
    if scene.sensor is not None:
        from vsfsim.generate.effectors.bubble import KINDS

        # its oracle VSF sticks to the dome, which needs no kernel
        inside = []
        if scene.sensor.camera is not None:
            from vsfsim.sensing import render_bubble

            inside = [render_bubble._inside]
        return [*pair_kernels(precision, KINDS), render_warp._cast, particles._behind, *inside]
    return [*solver_kernels(precision), render_warp._cast, particles._behind, stick_slip_kernel(wp.float64)[0]]


def _touches(scene_file: SceneFile) -> Any:
    spec = scene_file.sample(0).touches
    assert spec is not None
    return spec


# ---------------------------------------------------------------------------------------------- workers

_QUEUE: Any = None


def _work(jobs: list[Job], workers: int, device: str) -> Any:
    """Run the jobs; yields (frames newly done, name) as they come."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    # one thread a worker: a sum split over threads would depend on how many there are
    kept = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with ProcessPoolExecutor(workers, mp_context=context, initializer=_begin, initargs=(queue,)) as pool:
            waiting = {pool.submit(_make, job, device): job for job in jobs}
            feed: Any = threading.Thread(target=_end_feed, args=(list(waiting), queue), daemon=True)
            feed.start()
            while (item := queue.get()) is not None:
                yield item
            for future in as_completed(waiting):
                # those called off say nothing; the one that failed says why
                if not future.cancelled():
                    future.result()
    finally:
        for name, value in kept.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _end_feed(futures: list[Any], queue: Any) -> None:
    """Close the feed when all jobs are done, or at the first that fails (the others are then called off)."""
    for future in as_completed(futures):
        if future.exception() is not None:
            for other in futures:
                other.cancel()
            break
    queue.put(None)


def _begin(queue: Any) -> None:
    global _QUEUE
    _QUEUE = queue
    parent = multiprocessing.parent_process()
    if parent is not None:
        # a worker whose parent was killed must not go on writing beside the re-run
        threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def _make(job: Job, device: str) -> None:
    view = make_view(job, device=device, progress=lambda frames: _QUEUE.put((frames, job.name)))
    write_view(job.file, view)
