"""From a scene file to a dataset: every object view is one job, done by any worker with the same bits.

A job writes its file and then its line of the manifest, wherever it runs: in a process of this machine, as a shard on a
machine of its own, or as a task of a cluster. What has its line is finished.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.dataset import Dataset
from vsfsim.data.lines import finished_names, poisoned
from vsfsim.data.writer import DatasetWriter
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.workers import make_one
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.tiers import TIERS


@dataclass(frozen=True)
class Share:
    """What one call makes of a dataset, and how."""

    shard: tuple[int, int] | None = None
    """(i, n): the i-th of n shards, from 0; None for all that is missing."""
    finish: bool = False
    """Only check what shards have made, and write dataset.json."""
    mixed: bool = False
    """Whether machines of several kinds may make the dataset."""
    poison: bool = False
    """Whether a view that fails twice is left out and the others are made."""
    ray: str = ""
    """Address of the Ray cluster that makes the views, "" for this machine."""
    gpus: float = 0.0
    """Of each task of the cluster [1]."""


@dataclass(frozen=True)
class Made:
    """What a call has made."""

    names: tuple[str, ...]
    """Object views made by this call."""
    unfinished: int
    """Object views of the dataset that are still missing."""
    dataset: Dataset | None
    """The finished dataset, or None if a shard was made."""
    left_out: Mapping[str, str]
    """Object views that have failed twice, with the reason."""


def generate(scene_file: SceneFile, out: Path | str, *, share: Share | None = None, workers: int | None = None,
             cache: Path | None = None, progress: Callable[[int, int, str], None] | None = None,
             note: Callable[[str], None] | None = None, **recipe: Any) -> Dataset:
    """Make a dataset, or finish one that was begun; see `make`.

    Returns:
        The finished dataset.

    Raises:
        SceneError, MeshError, DatasetError: with what to do.
    """
    made = make(scene_file, out, share=share or Share(), workers=workers, cache=cache, progress=progress, note=note,
                **recipe)
    if made.dataset is None:
        raise DatasetError(f"{out}: a shard was made; the dataset is finished by `vsfsim generate --finish`.")
    return made.dataset


def make(scene_file: SceneFile, out: Path | str, *, share: Share, workers: int | None = None, cache: Path | None = None,
         progress: Callable[[int, int, str], None] | None = None, note: Callable[[str], None] | None = None,
         device: str = "cpu", **recipe: Any) -> Made:
    """Make a dataset or a share of it.

    Args:
        scene_file: with ``[touches]``.
        out: the folder, or the address of an object store.
        share: what this call makes.
        workers: processes, None for what suits the effector and the device.
        cache: folder of meshes that were made before, None for the user's own cache.
        progress: called with (frames done, frames in all, what).
        note: called with sentences for the user.
        device: Warp device.
        recipe: seed, objects, views, touches, tier, renderer and arm of `make_recipe`.

    Raises:
        SceneError, MeshError, DatasetError: with what to do.
    """
    found = make_recipe(scene_file, device=device, **recipe)
    scene = scene_file.sample(0)
    jobs = jobs_of(found, scene_file.path, out, cache, mixed=share.mixed, poison=share.poison)
    with DatasetWriter(out, found, [job.name for job in jobs], shard=share.shard, mixed=share.mixed) as writer:
        missing = set(writer.missing())
        mine = [job for k, job in enumerate(jobs) if job.name in missing and not share.finish
                and (share.shard is None or k % share.shard[1] == share.shard[0])]
        for sentence in writer.notes if note is not None else ():
            note(sentence)  # type: ignore[misc]
        if mine:
            work = _on_ray(mine, device, share) if share.ray else _here(mine, scene, device, workers, progress)
            total, done = len(mine) * found.touches * sum(scene.required_touches.frames), 0
            for frames, what in work:
                done += frames
                if progress is not None:
                    progress(done, total, what)
        if share.shard is not None:
            there = finished_names(writer.store)
            failed = poisoned(writer.store) if share.poison else {}
            return Made(tuple(job.name for job in mine if job.name in there), len(jobs) - len(there) - len(failed),
                        None, failed)
        dataset = writer.finish(leave_out=share.poison)
        return Made(tuple(job.name for job in mine), 0, dataset, dataset.left_out)


def _here(jobs: Sequence[Job], scene: Scene, device: str, workers: int | None,
          progress: Callable[[int, int, str], None] | None) -> Iterator[tuple[int, str]]:
    kernels = [one for tier in dict.fromkeys(job.recipe.tier for job in jobs) for one in kernels_of(scene, tier)]
    compile_kernels(kernels, device, progress=progress)
    yield from effector_of(scene).make_all(jobs, device=device, workers=workers)


def _on_ray(jobs: Sequence[Job], device: str, share: Share) -> Iterator[tuple[int, str]]:
    from vsfsim.core.engines import ray_cluster

    scene = jobs[0].scene().required_touches
    frames = jobs[0].recipe.touches * sum(scene.frames)
    for number, error in ray_cluster.run(partial(make_one, device=device), jobs, address=share.ray, gpus=share.gpus):
        if error and not share.poison:
            raise DatasetError(f"{jobs[number].name}: {error}")
        yield frames, jobs[number].name


def kernels_of(scene: Scene, tier: str = "auto") -> list[Any]:
    """The Warp kernels that a dataset of a scene needs: its effector's, the camera's and those of the oracle VSF."""
    from vsfsim.sensing import render_warp
    from vsfsim.vsf import particles

    if tier in TIERS:
        scene = dataclasses.replace(scene, object=dataclasses.replace(scene.required_object, tier=tier))
    return [*effector_of(scene).kernels(scene), render_warp.cast_kernel, particles._behind]
