"""Datasets of mock objects, and a task on them."""

from collections import Counter

from texts import text

from vsfsim.bench.mock import mock_view
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

TASK = text("toy-v1")


def recipe_of(views, **more):
    """The recipe of some views of mock objects."""
    splits = Counter({view.object_index: view.split for view in views}.values())
    return Recipe(**{"scene": "mock", "scene_text": "mock", "seed": 0, "objects": sum(splits.values()), "views": 1,
                     "touches": len(views[0].touches), "splits": dict(splits), "device": "cpu", "tier": "linear",
                     "precision": "float64", "renderer": "warp", **more})


def write(folder, views, **more):
    """The dataset of some views of mock objects, made in ``folder``."""
    with DatasetWriter(folder, recipe_of(views, **more), [view.name for view in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()


def written(folder, *, train=1, test=2, touches=12):
    """That of ``train`` and ``test`` objects."""
    return write(folder, [mock_view(i, split="train" if i < train else "test", touches=touches)
                          for i in range(train + test)])


def contents(folder):
    """The bytes of every file in a folder, by its path in it; None of a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in sorted(folder.rglob("*"))}
