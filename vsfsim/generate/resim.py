"""The true object asked again: touches of planned paths by the very model that made a dataset, which is what a
perfect model of object and solver would answer (`vsfsim evaluate --method resim`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shelf import find_scene, scenes
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.generate.effector import Planned, effector_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import check_files
from vsfsim.generate.solid import prepare


def again(recipe: Recipe, name: str, plans: Sequence[Planned], *, tier: str = "", device: str = "cpu") -> list[Touch]:
    """Build the object of a view from its recipe and touch it.

    Args:
        recipe: of the dataset. name: of the object view. plans: of the touches. tier: of the simulation; "" for the
        dataset's own. device: Warp device.

    Returns:
        One touch a plan, in their order.

    Raises:
        SceneError: the effector cannot repeat a plan, or has not this tier.
        DatasetError: a file that the scene names has changed.
    """
    path = find_scene(recipe.scene) if recipe.scene in scenes() else Path(f"{recipe.scene}.toml")
    check_files(recipe, path)
    effector = effector_of(parse_scene(recipe.scene_text, path).sample(0))
    repeat = getattr(effector, "touch_along", None)
    if repeat is None:
        raise SceneError(f"the touches of scene '{recipe.scene}' are not made again from their plans: its effector "
                         f"has no function `touch_along`. Rigid probes ([probe] in the scene) have one.")
    job = next(one for one in jobs_of(recipe, path, "", None) if one.name == name)
    if tier:
        chosen = effector.check(job.scene(), tier, recipe.precision)
        job = dataclasses.replace(job, recipe=dataclasses.replace(recipe, tier=chosen))
    return repeat(prepare(job, device=device), plans, device=device)
