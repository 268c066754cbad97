"""From a scene file to a dataset: every object view is one job, done by any worker with the same bits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.dataset import Dataset
from vsfsim.data.writer import DatasetWriter
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics.runtime import compile_kernels


def generate(scene_file: SceneFile, out: Path, *, seed: int = 0, objects: int | None = None, views: int | None = None,
             touches: int | None = None, tier: str | None = None, device: str = "cpu", precision: str = "float64",
             renderer: str = "warp", workers: int | None = None, cache: Path | None = None, arm: str | None = None,
             progress: Callable[[int, int, str], None] | None = None,
             note: Callable[[str], None] | None = None) -> Dataset:
    """Make a dataset, or finish one that was begun.

    Args:
        scene_file: with ``[touches]``.
        out: the folder.
        seed: root of all random streams, 0 or more.
        objects, views, touches: counts, None for the scene's own.
        tier: fidelity, None for the scene's own.
        device: Warp device.
        precision: of the solver, "float32" or "float64".
        renderer: "warp" or "pyrender".
        workers: processes, None for what suits the effector and the device.
        cache: folder of meshes that were made before, None for the user's own cache.
        arm: model that touches instead of the scene's own.
        progress: called with (frames done, frames in all, what).
        note: called with sentences for the user.

    Raises:
        SceneError, MeshError, DatasetError: with what to do.
    """
    recipe = make_recipe(scene_file, seed=seed, objects=objects, views=views, touches=touches, tier=tier, device=device,
                         precision=precision, renderer=renderer, arm=arm)
    scene = scene_file.sample(0)
    jobs = jobs_of(recipe, scene_file.path, out, cache)
    with DatasetWriter(out, recipe, [job.name for job in jobs]) as writer:
        missing = set(writer.missing())
        jobs = [job for job in jobs if job.name in missing]
        if note is not None:
            for sentence in writer.notes:
                note(sentence)
        total = len(jobs) * recipe.touches * sum(scene.required_touches.frames)
        done = 0
        if jobs:
            compile_kernels(kernels_of(scene, recipe.precision), device, progress=progress)
            for frames, what in effector_of(scene).make_all(jobs, device=device, workers=workers):
                done += frames
                if progress is not None:
                    progress(done, total, what)
        return writer.finish()


def kernels_of(scene: Scene, precision: str) -> list[Any]:
    """The Warp kernels that a dataset of a scene needs: its effector's, the camera's and those of the oracle VSF."""
    from vsfsim.sensing import render_warp
    from vsfsim.vsf import particles

    return [*effector_of(scene).kernels(scene, precision), render_warp.cast_kernel, particles._behind]
