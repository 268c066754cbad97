"""Worlds in which the papers' model is exact: blocks of independent springs (`vsfsim.bench.mock`), made in seconds.

A claim that holds there and not on a task's objects fails because of the data; one that does not hold there fails
because of the method.
"""

from __future__ import annotations

from pathlib import Path

from vsfsim.bench.mock import mock_view
from vsfsim.bench.task import Task, parse_task
from vsfsim.core.errors import DatasetError
from vsfsim.core.shelf import datasets
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

_OBJECTS, _TOUCHES = 24, 23

_TASK = """
name = "NAME-v1"
description = "DESCRIPTION"
dataset = { folder = "NAME-v1", scene = "NAME", seed = 0, objects = 24, views = 1, touches = 23, tier = "auto" }
protocol = { folds = 4, draws = 4, trainings = 3, shots = [0, 1, 5, 10], query = 8, seed = 0 }
observation = { kind = "normal-force" }
noise = { force_std = 0.05, offset_std = 0.1, drift_std = 0.0, tare_frames = 2, seed = 0 }
metrics = { primary = "rmse_ratio", ranking_shot = 5 }
"""

WORLDS = {"springs": "24 blocks of independent springs, one half stiffer and darker than the other",
          "springs-blind": "the same blocks, of which the picture does not tell which half is stiffer"}
"""What they are, by name."""


def task(world: str) -> Task:
    """The few-shot task of a world, with the protocol of the tasks with shoes.

    Args:
        world: a key of `WORLDS`.
    """
    name = f"world-{world}"
    return parse_task(_TASK.replace("NAME", name).replace("DESCRIPTION", WORLDS[world]), Path(f"{name}.toml"))


def dataset(world: str) -> Dataset:
    """Its dataset, made under the datasets' folder if it is not there.

    Raises:
        DatasetError: it is damaged, or cannot be written.
    """
    name = f"world-{world}"
    path = datasets() / f"{name}-v1"
    try:
        found = Dataset.open(path)
        if found.recipe.scene_text == WORLDS[world]:
            return found
        raise DatasetError(f"{path} holds another dataset than the world '{world}'. Remove that folder.")
    except DatasetError:
        if path.exists():
            raise
    told = world == "springs"
    views = [mock_view(k, split="train", touches=_TOUCHES, dark=(k % 2 if not told else 0)) for k in range(_OBJECTS)]
    recipe = Recipe(scene=name, scene_text=WORLDS[world], seed=0, objects=_OBJECTS, views=1, touches=_TOUCHES,
                    splits={"train": _OBJECTS}, device="cpu", tier="vsf", precision="float64", renderer="warp")
    with DatasetWriter(path, recipe, [v.name for v in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()
