"""Datasets of mock objects, and a task on them."""

from collections import Counter

from texts import text

from vsfsim.bench.mock import mock_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

TASK = text("toy-v1")


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
