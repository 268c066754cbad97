"""`vsfsim.generate(scene, out)` and `vsfsim generate SCENE`: a dataset from a scene's name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.arm_spec import ARM_MODELS
from vsfsim.core.errors import DatasetError, VsfsimError, did_you_mean
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.shelf import dataset_folder, datasets, find_scene
from vsfsim.data.archive import taken
from vsfsim.data.dataset import Dataset
from vsfsim.data.store import is_url
from vsfsim.generate import run
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.trade.buy import bought, check_accuracy
from vsfsim.physics.runtime import check_device

RENDERERS = ("warp", "pyrender")


def generate(scene: str | Path | SceneFile, out: str | Path | None = None, *, objects: int | None = None,
             views: int | None = None, touches: int | None = None, seed: int = 0, tier: str | None = None,
             device: str = "cpu", renderer: str = "warp", arm: str | None = None,
             accuracy: float | None = None, workers: int | None = None, cache: Path | None = None,
             share: run.Share | None = None, progress: Callable[[int, int, str], None] | None = None,
             note: Callable[[str], None] | None = None) -> Dataset:
    """Make a dataset, or finish one that was interrupted, to the same bits; `vsfsim.generate` is this function.

    With ``share`` it may be made by a cluster; a shard alone is made by `make`.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene; it has ``[touches]``.
        out: the folder; None for the folder in which a task looks for this dataset
            (`vsfsim.core.shelf.dataset_folder`).
        objects, views, touches: how many, None for the scene's own numbers.
        seed: root of all random numbers.
        tier: fidelity, None for the scene's own.
        device: Warp device, "cpu" or "cuda:0".
        renderer: "warp" or "pyrender".
        arm: model of the arm, of a scene with ``[arm]``; None for the scene's own.
        accuracy: largest error of the force over its largest value in a touch [-], for which a pilot chooses tier and
            element size, and by which some touches are audited; None for the scene's own tier.
        workers: processes, None for one a CPU core, or one for 5 GiB of a GPU, 16 at most and one a core.
        cache: folder of meshes that were made before, None for the user's own cache.
        share: what is made and where (`vsfsim.generate.run.Share`), None for all of it on this machine.
        progress: called with (frames done, frames in all, what).
        note: called with sentences for the user.

    Raises:
        VsfsimError: there is no such scene, it cannot be built, or an option has a value that is not allowed.
    """
    made = make(scene, out, objects=objects, views=views, touches=touches, seed=seed, tier=tier, device=device,
                renderer=renderer, arm=arm, accuracy=accuracy, workers=workers, cache=cache,
                share=share, progress=progress, note=note)
    if made.dataset is None:
        raise DatasetError(f"{out}: a shard was made; the dataset is finished by `vsfsim generate --finish`.")
    return made.dataset


def make(scene: str | Path | SceneFile, out: str | Path | None = None, *, seed: int = 0, objects: int | None = None,
         views: int | None = None, touches: int | None = None, tier: str | None = None, device: str = "cpu",
         renderer: str = "warp", arm: str | None = None, accuracy: float | None = None,
         workers: int | None = None, cache: Path | None = None, share: run.Share | None = None,
         progress: Callable[[int, int, str], None] | None = None,
         note: Callable[[str], None] | None = None) -> run.Made:
    """As `generate`, for a shard too.

    Raises:
        VsfsimError: as `generate`.
    """
    loaded = scene if isinstance(scene, SceneFile) else load_scene(find_scene(str(scene)))
    check_device(device)
    choices: list[tuple[str, Any, tuple[str, ...]]] = [("--renderer", renderer, RENDERERS), ("--arm", arm, ARM_MODELS)]
    for option, value, allowed in choices:
        if value is not None and value not in allowed:
            raise VsfsimError(f"{option} is '{value}'. {did_you_mean(value, allowed)}")
    if accuracy is not None:
        check_accuracy(accuracy, tier)
    folder = folder_of(loaded, out, accuracy=accuracy, seed=seed, objects=objects, views=views, touches=touches,
                       tier=tier, arm=arm)
    if share is not None and share.ray:
        folder = folder if is_url(folder) else Path(folder).resolve()  # tasks have working folders of their own
    if (share is None or share == run.Share()) and isinstance(folder, Path) and accuracy is None and (
            device, renderer, arm) == ("cpu", "warp", None):
        known = folder_of(loaded, None, seed=seed, objects=objects, views=views, touches=touches, tier=tier, arm=arm)
        found = taken(folder, Path(known).name, progress=progress, note=note)  # with other options the bits are others
        if found is not None:
            return run.Made((), 0, found, {})
    options: dict[str, Any] = {"seed": seed, "objects": objects, "views": views, "touches": touches, "tier": tier,
                               "device": device, "renderer": renderer, "arm": arm}
    if accuracy is not None:
        count = make_recipe(loaded, **options).objects
        options["tier"], options["bought"] = bought(loaded, folder, accuracy, seed=seed, objects=count, device=device,
                                                    cache=cache, note=note)
    return run.make(loaded, folder, share=share or run.Share(), workers=workers, cache=cache, progress=progress,
                    note=note, **options)


def folder_of(scene: SceneFile, out: str | Path | None, *, accuracy: float | None = None,
              **options: Any) -> Path | str:
    """Where a dataset goes: ``out``, or where a task looks for it.

    Args:
        scene: the scene.
        out: the folder that was given, or None.
        accuracy: that was asked for; no task looks for such a dataset.
        options: of `make_recipe`.

    Raises:
        SceneError: as `make_recipe`.
    """
    if out is not None:
        return str(out) if is_url(out) else Path(out)
    recipe = make_recipe(scene, **options)
    if accuracy is not None:
        return datasets() / f"{scene.name}-accuracy-{100 * accuracy:g}"
    return dataset_folder(scene.name, text=scene.text, seed=recipe.seed, objects=recipe.objects, views=recipe.views,
                          touches=recipe.touches, tier=recipe.tier)
