"""Datasets of mock objects, and a task on them."""

from collections import Counter

from vsfsim.bench.mock import mock_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

TASK = """
name = "toy-v1"
description = "A toy."
dataset = { folder = "toy", scene = "mock", seed = 0, objects = 3, views = 1, touches = 12, tier = "linear" }
protocol = { train = "train", test = "test", shots = [0, 1, 5], seeds = 2, query = 4, seed = 0 }
observation = { kind = "normal-force" }
noise = { force_std = 0.15, offset_std = 0.5, drift_std = 0.0, tare_frames = 2, seed = 0 }
metrics = { primary = "rmse", ranking_shot = 5 }
"""


def write(folder, views, scene_text="mock", seed=0):
    """The dataset of some views of mock objects, made in ``folder``."""
    splits = Counter({view.object_index: view.split for view in views}.values())
    recipe = Recipe(scene="mock", scene_text=scene_text, seed=seed, objects=sum(splits.values()), views=1,
                    touches=len(views[0].touches), splits=dict(splits), device="cpu", tier="linear",
                    precision="float64", renderer="warp")
    with DatasetWriter(folder, recipe, [view.name for view in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()


def written(folder, *, train=1, test=2, touches=12):
    """That of ``train`` and ``test`` objects."""
    return write(folder, [mock_view(i, split="train" if i < train else "test", touches=touches)
                          for i in range(train + test)])


def contents(folder):
    """The bytes of every file in a folder, by its name."""
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}
