"""`vsfsim.generate(scene, out)` and `vsfsim generate SCENE`: every object view is one job, done by any worker with the
same bits.

A job writes its file and then its line of the manifest, wherever it runs: in a process of this machine, as a shard on a
machine of its own, or as a task of a cluster. What has its line is finished.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError, one_of
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import dataset_folder, datasets, find_scene
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import is_url
from vsfsim.data.formats.archive import unpack
from vsfsim.data.lines import finished_names, poisoned
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter
from vsfsim.generate.effector import effector_of, kernels_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.trade.buy import bought, check_accuracy
from vsfsim.generate.workers import make_one
from vsfsim.physics.runtime import check_device, compile_kernels
from vsfsim.sensing.camera import RENDERERS

ALLOWED = ("mixed", "poison")


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


@dataclass(frozen=True)
class Plan:
    """A dataset that is to be made, checked before the work."""

    loaded: SceneFile
    """With ``[touches]``."""
    request: Request
    """As it was asked for."""
    recipe: Recipe
    """What will be made."""
    folder: Path | str
    """Where: a folder, or the address of an object store."""


def planned(scene: str | Path | SceneFile, out: str | Path | None = None,
            request: Request | None = None, **options: Any) -> Plan:
    """Look at what is asked; arguments and errors as `generate`."""
    asked = (request or Request()).but(**options)
    loaded = scene if isinstance(scene, SceneFile) else load_scene(find_scene(str(scene)))
    check_device(asked.device)
    for option, word, known in (("--renderer", asked.renderer, RENDERERS),
                                *(("--allow", word, ALLOWED) for word in asked.allow)):
        one_of(word, known, option)
    if asked.accuracy is not None:
        check_accuracy(asked.accuracy, asked.tier)
    recipe = make_recipe(loaded, asked)
    if out is not None:
        return Plan(loaded, asked, recipe, str(out) if is_url(out) else Path(out))
    if asked.accuracy is not None:  # no task looks for such a dataset
        return Plan(loaded, asked, recipe, datasets() / f"{loaded.name}-accuracy-{100 * asked.accuracy:g}")
    return Plan(loaded, asked, recipe, dataset_folder(
        loaded.name, text=loaded.text, seed=recipe.seed, objects=recipe.objects, views=recipe.views,
        touches=recipe.touches, tier=recipe.tier))


def generate(scene: str | Path | SceneFile, out: str | Path | None = None,
             request: Request | None = None, **options: Any) -> Dataset:
    """Make a dataset, or finish one that was interrupted, to the same bits; `vsfsim.generate` is this function.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene; it has ``[touches]``.
        out: the folder, or the address of an object store; None for the folder in which a task looks for this dataset
            (`vsfsim.core.shelf.dataset_folder`).
        request: what is asked, None for the scene's own.
        options: fields of `vsfsim.core.scene_tables.request.Request` that are others than those of ``request``.

    Raises:
        VsfsimError: there is no such scene, it cannot be built, or an option has a value that is not allowed.
    """
    made = make(planned(scene, out, request, **options))
    if made.dataset is None:
        raise DatasetError(f"{out}: a shard was made; the same call without it finishes the dataset.")
    return made.dataset


def make(plan: Plan) -> Made:
    """Make a dataset, or the share of it that its request names.

    Raises:
        VsfsimError: as `generate`.
    """
    loaded, asked, recipe, folder = plan.loaded, plan.request, plan.recipe, plan.folder
    shard, note = asked.fan.shard, asked.note
    if asked.fan.ray and isinstance(folder, Path):
        folder = folder.resolve()  # tasks have working folders of their own
    if asked.accuracy is not None:
        tier, options = bought(loaded, folder, asked, recipe)
        recipe = make_recipe(loaded, asked.but(tier=tier), bought=options)
    if isinstance(folder, Path):
        unpack(recipe, folder, note)
    jobs = jobs_of(recipe, loaded.path, folder, asked.allow)
    with DatasetWriter(folder, recipe, [job.name for job in jobs], shard=shard) as writer:
        missing = set(writer.missing())
        mine = [job for k, job in enumerate(jobs) if job.name in missing
                and (shard is None or k % shard[1] == shard[0])]
        for sentence in writer.notes:
            note(sentence)
        if mine:
            for done, name in enumerate(_on_ray(mine, asked) if asked.fan.ray else _here(mine, asked), start=1):
                asked.progress(done, len(mine), name)
        if shard is not None:
            there = finished_names(writer.store)
            failed = poisoned(writer.store) if "poison" in asked.allow else {}
            return Made(tuple(job.name for job in mine if job.name in there),
                        len(jobs) - len(there) - len(failed), None, failed)
        dataset = writer.finish(leave_out="poison" in asked.allow)
        return Made(tuple(job.name for job in mine), 0, dataset, dataset.left_out)


def _here(jobs: Sequence[Job], asked: Request) -> Iterator[str]:
    scene = jobs[0].scene()
    compile_kernels(kernels_of(scene, jobs[0].recipe.tier), asked.device, progress=asked.progress)
    asked.progress(0, len(jobs), jobs[0].name)
    yield from effector_of(scene).make_all(jobs, device=asked.device, workers=asked.workers)


def _on_ray(jobs: Sequence[Job], asked: Request) -> Iterator[str]:
    from vsfsim.core.system import engines

    for number, error in engines.on_ray(partial(make_one, device=asked.device), jobs,
                                        address=asked.fan.ray, gpus=asked.fan.gpus):
        if error and "poison" not in asked.allow:
            raise DatasetError(f"{jobs[number].name}: {error}")
        yield jobs[number].name
