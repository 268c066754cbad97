"""What `vsfsim generate` will make: the scene's own numbers, or those asked for, checked before the work."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vsfsim.core import shelf
from vsfsim.core.errors import DatasetError, SceneError
from vsfsim.core.scene import Scene, SceneFile, parse_scene
from vsfsim.core.scene_tables.dataset import DatasetSpec
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.system.content import differences, file_sha256, named_files, source_sha256
from vsfsim.data.recipe import Recipe
from vsfsim.generate.effector import effector_of


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


def make_recipe(scene_file: SceneFile, request: Request | None = None, *,
                bought: Mapping[str, Any] | None = None, **options: Any) -> Recipe:
    """What will be made of a request, with other values of some ``options``; None takes the scene's own number.
    ``bought`` is what an accuracy has chosen, see `vsfsim.generate.trade.buy`.

    Raises:
        SceneError: the scene has no ``[touches]``, a count is less than 1, or its effector refuses something.
    """
    asked, scene = (request or Request()).but(**options), scene_file.sample(0)
    if scene.touches is None:
        raise SceneError(f"{scene_file.path}: there is no [touches]; a dataset needs count, depth "
                         "and frames of its touches.")
    effector = effector_of(scene)
    given = scene.dataset or DatasetSpec(1, 1, {})
    objects, views, touches = (own if number is None else number for own, number in (
        (given.objects, asked.objects), (given.views, asked.views), (scene.touches.count, asked.touches)))
    for name, number in (("--objects", objects), ("--views", views), ("--touches", touches),
                         ("--seed + 1", asked.seed + 1)):
        if number < 1:
            raise SceneError(f"{name} is {number}; it must be at least 1.")
    return Recipe(scene=scene_file.name, scene_text=scene_file.text, seed=asked.seed,
                  objects=objects, views=views, touches=touches, splits=splits_for(scene, objects),
                  device=asked.device.split(":")[0], tier=effector.check(scene, asked.tier),
                  precision="float64", renderer=asked.renderer, options=dict(bought or {}),
                  files=files_of(scene_file, scene.effector))


def files_of(scene_file: SceneFile, effector: str) -> dict[str, str]:
    """sha256 of every file that a scene names, and of the source of its effector and its families where they are from
    another package, by name; see `Recipe.files`.

    Args:
        scene_file: as written. effector: its name.
    """
    out = {text: file_sha256(path) for text, path in named_files(scene_file.tree, scene_file.path.parent).items()}
    for entry in shelf.plug_ins(scene_file.tree, effector):
        out[f"the plug-in {entry.name}"] = source_sha256(entry.module)
    return out


def check_files(recipe: Recipe, path: Path) -> None:
    """Refuse to go on if what decides the numbers is no longer what it was.

    Args:
        recipe: of the dataset. path: of its scene file, to which the names of files are relative.

    Raises:
        DatasetError: a file that the scene names has changed since the recipe was made.
    """
    if recipe.files:
        written = parse_scene(recipe.scene_text, path)
        changed = differences(recipe.files, files_of(written, written.sample(0).effector))
        if changed:
            raise DatasetError("the dataset cannot go on, because while it was made "
                               f"{'; '.join(changed)}. Restore what it was made from, or delete "
                               "the folder and generate it again.")
