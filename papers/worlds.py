"""Worlds in which the papers' model is exact: blocks of independent springs (`vsfsim.bench.mock`), made in seconds.

A claim that holds there and not on a task's objects fails because of the data; one that does not hold there fails
because of the method.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from vsfsim.bench.mock import mock_view
from vsfsim.bench.task import Task, parse_task
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import datasets
from vsfsim.core.table import parse_toml, read_text
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

_PATH = Path(__file__).with_name("worlds.toml")
_GIVEN = parse_toml(read_text(_PATH, "table of worlds", TaskError), _PATH, "table of worlds", TaskError)
_TASK: str = _GIVEN["task"]
WORLDS: Mapping[str, str] = _GIVEN["worlds"]
"""What they are, by name."""
CLASSES: Mapping[str, float] = _GIVEN["classes"]
"""Factor on every spring of each class of blocks [-]."""


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
