"""`vsfsim.generate(scene, out)` and `vsfsim generate SCENE`: a dataset from a scene's name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from vsfsim.core.arm_spec import ARM_MODELS
from vsfsim.core.errors import VsfsimError, did_you_mean
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.shelf import dataset_folder, find_scene
from vsfsim.data.dataset import Dataset
from vsfsim.generate import run
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics.runtime import check_device, check_precision

RENDERERS = ("warp", "pyrender")


def generate(scene: str | Path | SceneFile, out: str | Path | None = None, *, objects: int | None = None,
             views: int | None = None, touches: int | None = None, seed: int = 0, tier: str | None = None,
             device: str = "cpu", precision: str = "float64", renderer: str = "warp", arm: str | None = None,
             workers: int | None = None, cache: Path | None = None,
             progress: Callable[[int, int, str], None] | None = None,
             note: Callable[[str], None] | None = None) -> Dataset:
    """Make a dataset, or finish one that was interrupted, to the same bits; `vsfsim.generate` is this function.

    Args:
        scene: name of a shipped scene, path of a .toml file, or a loaded scene; it has ``[touches]``.
        out: the folder; None for the folder in which a task looks for this dataset
            (`vsfsim.core.shelf.dataset_folder`).
        objects, views, touches: how many, None for the scene's own numbers.
        seed: root of all random numbers.
        tier: fidelity, None for the scene's own.
        device: Warp device, "cpu" or "cuda:0".
        precision: of the solver, "float64" or "float32".
        renderer: "warp" or "pyrender".
        arm: model of the arm, of a scene with ``[arm]``; None for the scene's own.
        workers: processes, None for one a CPU core, or one on a GPU.
        cache: folder of meshes that were made before, None for the user's own cache.
        progress: called with (frames done, frames in all, what).
        note: called with sentences for the user.

    Raises:
        VsfsimError: there is no such scene, it cannot be built, or an option has a value that is not allowed.
    """
    loaded = scene if isinstance(scene, SceneFile) else load_scene(find_scene(str(scene)))
    check_device(device)
    check_precision(precision)
    choices: list[tuple[str, Any, tuple[str, ...]]] = [("--renderer", renderer, RENDERERS), ("--arm", arm, ARM_MODELS)]
    for option, value, allowed in choices:
        if value is not None and value not in allowed:
            raise VsfsimError(f"{option} is '{value}'. {did_you_mean(value, allowed)}")
    folder = folder_of(loaded, out, seed=seed, objects=objects, views=views, touches=touches, tier=tier, arm=arm)
    options = {"seed": seed, "objects": objects, "views": views, "touches": touches, "tier": tier, "device": device,
               "precision": precision, "renderer": renderer, "arm": arm}
    return run.generate(loaded, folder, workers=workers, cache=cache, progress=progress, note=note, **options)


def folder_of(scene: SceneFile, out: str | Path | None, **options: Any) -> Path:
    """Where a dataset goes: ``out``, or where a task looks for it.

    Args:
        scene: the scene.
        out: the folder that was given, or None.
        options: of `make_recipe`.

    Raises:
        SceneError: as `make_recipe`.
    """
    if out is not None:
        return Path(out)
    recipe = make_recipe(scene, **options)
    return dataset_folder(scene.name, text=scene.text, seed=recipe.seed, objects=recipe.objects, views=recipe.views,
                          touches=recipe.touches, tier=recipe.tier)
