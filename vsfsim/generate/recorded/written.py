"""What all datasets of recordings have: touches without a residual, an empty truth, and their recipe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import whole_folder
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import AUDIT_COLUMNS, ObjectView, Touch, Truth
from vsfsim.data.writer import DatasetWriter

SPLIT = "recorded"


def recorded_touch(*, time: np.ndarray, **fields: Any) -> Touch:
    """A touch of T frames that nobody solved: fields of `Touch`, and nothing known of the supports and the solver."""
    frames, unread = len(time), np.full(len(time), np.nan)
    return Touch(time=time, reaction=np.full((frames, 3), np.nan), converged=np.ones(frames, bool), residual=unread,
                 iterations=np.zeros(frames, np.int64), reason=np.zeros(frames, np.int64),
                 audit={name: unread for name in AUDIT_COLUMNS if name != "min_det_f"}, **fields)


def nothing_known(what: str) -> Truth:
    """An empty truth; ``what`` says in words what was recorded."""
    return Truth(points=np.zeros((0, 3)), young_modulus=np.zeros(0), region=np.zeros(0, np.int64), region_names=(),
                 notes=(f"{what}; nothing of its stiffness is known.",))


def write_recorded(folder: Path, out: Path, views: Sequence[ObjectView], text: str,
                   options: Mapping[str, Any] = {}) -> Dataset:
    """Write object views that were read from a folder, whole or not at all.

    Args:
        folder: whose name is that of the scene. out: the new folder. views: of it. text: in place of a scene's text.
        options: of the recipe.

    Raises:
        DatasetError: the new folder exists, or the disk refuses.
    """
    recipe = Recipe(scene=folder.resolve().name, scene_text=text, seed=0, objects=len(views), views=1,
                    touches=min(len(v.touches) for v in views), splits={SPLIT: len(views)}, device="none", tier=SPLIT,
                    precision="float64", renderer="none", options=options)
    with whole_folder(out) as part:
        with DatasetWriter(part, recipe, [view.name for view in views]) as writer:
            for view in views:
                writer.add(view, "a real robot")
            writer.finish()
    return Dataset.open(out)
