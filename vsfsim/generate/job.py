"""One object view to make."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.scene import Scene, parse_scene
from vsfsim.data.recipe import Recipe
from vsfsim.data.streams import Stream, stream


@dataclass(frozen=True)
class Job:
    """One object view to make."""

    recipe: Recipe
    """Recipe of the dataset."""
    path: Path
    """Path of the scene file; mesh paths are relative to it."""
    name: str
    """Name of the view."""
    split: str
    """Split of its object."""
    object_index: int
    """Number of the object, from 0."""
    view_index: int
    """Number of the view of that object, from 0."""
    store: str
    """Folder or address of the dataset."""
    allow: Sequence[str] = ()
    """What is refused otherwise, see `vsfsim.core.scene_tables.request.Request`."""

    def scene(self) -> Scene:
        """The scene of this object, with the recipe's own number of touches, and its own element size, readings on the
        way in and nodes of a bubble where its options name them."""
        written, options = parse_scene(self.recipe.scene_text, self.path), self.recipe.options
        written = written.varied("touches", count=self.recipe.touches)
        for table, key in (("object", "resolution"), ("sensor", "nodes")):
            if key in options:
                written = written.varied(table, **{key: options[key]})
        if "frames" in options:
            phases = {**written.tree["touches"].get("frames", {}), "in": options["frames"]}
            written = written.varied("touches", frames=phases)
        return written.sample(self.stream(Stream.SCENE), number=self.object_index)

    def stream(self, kind: Stream, touch: int | None = None) -> np.random.SeedSequence:
        """The random stream of a kind for this object, view, or touch of it."""
        keys: dict[Stream, tuple[Any, ...]] = {
            Stream.SCENE: (), Stream.BODY: (), Stream.DEPTH: (self.view_index,), Stream.AUDIT: (self.view_index,),
            Stream.AIM: (self.view_index, touch)}
        return stream(self.recipe.seed, kind, self.object_index, *keys[kind])


def jobs_of(recipe: Recipe, path: Path, store: Path | str, allow: Sequence[str] = ()) -> list[Job]:
    """One job for every object view, in order; their files lie in ``store``."""
    split_of = [name for name, n in recipe.splits.items() for _ in range(n)]
    names = [(o, v, f"{recipe.scene}-{o:04d}-v{v}") for o in range(recipe.objects) for v in range(recipe.views)]
    return [Job(recipe, path, name, split_of[o], o, v, str(store), allow) for o, v, name in names]
