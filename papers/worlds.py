"""Worlds in which the papers' model is exact: blocks of independent springs (`vsfsim.bench.mock`), made in seconds.

A claim that holds there and not on a task's objects fails because of the data; one that does not hold there fails
because of the method.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from vsfsim.bench.mock import mock_view
from vsfsim.bench.task import Task, parse_task
from vsfsim.core.shelf import datasets
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

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
          "springs-blind": "the same blocks, of which the picture does not tell which half is stiffer",
          "springs-looks": "the same blocks, each in two colours of its own, which tell nothing",
          "springs-classes": "24 such blocks of four classes, each class twice as stiff as the one before; the picture "
                             "tells every other class from the rest"}
"""What they are, by name."""

CLASSES = {"soft": 0.5, "medium": 1.0, "firm": 2.0, "hard": 4.0}
"""Factor on every spring of each class of blocks [-]. Blocks of a class differ by up to four times besides, as those of
the other worlds do."""


def task(world: str) -> Task:
    """The few-shot task of a world, with the protocol of the tasks with shoes.

    Args:
        world: a key of `WORLDS`.
    """
    name = f"world-{world}"
    return parse_task(_TASK.replace("NAME", name).replace("DESCRIPTION", WORLDS[world]), Path(f"{name}.toml"))


def scene_text(world: str) -> str:
    """What stands in the place of a scene's text: what the world is, and the class of each block where it has classes,
    as a scene names its models."""
    if world != "springs-classes":
        return WORLDS[world]
    return f"# {WORLDS[world]}\n[object.shape]\nmodel = {{ each = {json.dumps(list(CLASSES))} }}\n"


def dataset(world: str) -> Dataset:
    """Its dataset, made under the datasets' folder if it is not there.

    Raises:
        DatasetError: its folder holds another dataset, or it cannot be written.
    """
    wanted = task(world).dataset
    told, factors = world == "springs", list(CLASSES.values()) if world == "springs-classes" else [1.0]
    views = {v.name: v for v in (mock_view(k, split="train", touches=wanted.touches, dark=0 if told else k % 2,
                                           stiffness=factors[k % len(factors)],
                                           colours=_colours(k) if world == "springs-looks" else None)
                                 for k in range(wanted.objects))}
    recipe = Recipe(scene=wanted.scene, scene_text=scene_text(world), seed=wanted.seed, objects=wanted.objects,
                    views=wanted.views, touches=wanted.touches, splits={"train": wanted.objects}, device="cpu",
                    tier="vsf", precision="float64", renderer="warp")
    with DatasetWriter(datasets() / wanted.folder, recipe, list(views)) as writer:
        for name in writer.missing():
            writer.add(views[name])
        return writer.finish()


def _colours(index: int) -> np.ndarray:
    """Of a block's two halves (2, 3) uint8, drawn at random."""
    return np.random.default_rng(index).integers(20, 236, (2, 3), dtype=np.uint8)
