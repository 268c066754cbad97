"""The seam between what touches and everything else.

An *effector* is what touches an object: a rigid probe, an air-filled bubble, an arm. `generate`, `press` and `inspect`
know the protocol `Effector` and no effector by name: a scene's ``effector`` says which one it needs, and `effector_of`
loads it.

A new effector, say ``[sensor] kind = "scale"``, is

1. a file ``scale.py`` in ``vsfsim/generate/effectors/`` (in another package, an entry point ``scale`` of the
   group ``vsfsim.effectors``) whose attribute ``EFFECTOR`` has the methods of `Effector`. It reads its settings from
   `Scene.effector_table`. One that differs from another effector in a few methods inherits or calls the others.
2. a row ``touches/*/channels/NAME`` in `vsfsim.data.schema` for every new quantity that it records in `Touch.channels`;
   files describe it, so that they are read without the package,
3. a row in `vsfsim.bench.observations` for every quantity that a task may ask for; in another package an entry point of
   the group ``vsfsim.observations``.

``tests/generate/test_new_effector.py`` adds one.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from vsfsim.core.errors import SceneError, one_of
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import EFFECTOR_GROUP, effectors, loaded
from vsfsim.data.records import ObjectView
from vsfsim.generate.job import Job
from vsfsim.generate.press_result import PressResult
from vsfsim.physics.tiers import TIERS
from vsfsim.sensing.cut import Elements
from vsfsim.sensing.surface import Surface


@dataclass(frozen=True)
class Drawing:
    """What `vsfsim show` shows of a scene."""

    surface: Surface
    """The surface to draw."""
    young_modulus: np.ndarray | None
    """Young's modulus of each triangle (f,) [Pa], or None to leave the colours of stiffness out."""
    subtitle: str | None
    """Follows the scene's name in the picture's title; None for the seed."""
    lines: tuple[str, ...]
    """What is printed; the scene's name is put before the first line."""
    body: Elements | None = None
    """Its elements, placed as the surface is. None where it has none."""


class Effector(Protocol):
    """What touches: how it is checked, how it makes touches, what it records."""

    table: str
    """The scene's table that describes it: "probe", "sensor" or "arm"."""

    def check(self, scene: Scene, tier: str | None) -> str:
        """Refuse at once a dataset that could not be made.

        Args:
            scene: concrete, with ``[touches]``.
            tier: fidelity asked for, or None for the scene's own.

        Returns:
            The tier at which the object is simulated.

        Raises:
            SceneError: what is wrong, and what to do.
        """
        ...

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Names of the optional rows of `vsfsim.data.schema` that every touch of this scene fills."""
        ...

    def kernels(self, scene: Scene) -> list[Any]:
        """The Warp kernels that its touches launch, to be compiled before the workers start; the scene's object names
        the tier."""
        ...

    def make_view(self, job: Job, *, device: str) -> ObjectView:
        """Make one object view: build the object, take its picture, aim, touch, and record the truth.

        Args:
            job: which view of which recipe.
            device: Warp device.

        Raises:
            SceneError, MeshError: the object cannot be built, or no touch can be aimed.
        """
        ...

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
        """Make and write the views of some jobs; yields the name of each as they come.

        Args:
            jobs: what to make.
            device: Warp device.
            workers: processes, or None for what suits the device.
        """
        ...

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """Carry out the ``[press]`` of a scene, or the press that stands for it.

        Raises:
            SceneError, MeshError: the press cannot be made.
        """
        ...

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """The scene of the press on ``meshes`` >= 3 finer and finer meshes.

        Raises:
            SceneError, MeshError: its model has no finer mesh.
        """
        ...

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """What `vsfsim show` shows of a scene.

        Args:
            scene: concrete.
            seed: of what a family draws.
        """
        ...


def effector_of(scene: Scene) -> Effector:
    """The effector that a scene asks for.

    Raises:
        SceneError: there is none.
    """
    name = one_of(scene.effector, effectors(), "the effector", SceneError)
    for entry in importlib.metadata.entry_points(group=EFFECTOR_GROUP, name=name):
        return loaded(entry, "the effector", SceneError)
    return importlib.import_module(f"vsfsim.generate.effectors.{name}").EFFECTOR


def kernels_of(scene: Scene, tier: str = "auto") -> list[Any]:
    """The Warp kernels that a dataset of a scene needs: its effector's and the camera's."""
    from vsfsim.sensing import render_warp

    if tier in TIERS:
        body = dataclasses.replace(scene.required_object, tier=tier)  # type: ignore[arg-type]
        scene = dataclasses.replace(scene, object=body)
    return [*effector_of(scene).kernels(scene), render_warp.cast_kernel]
