"""A solid object that is ready to be touched: built, placed and photographed."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from vsfsim.core.scene import CameraSpec, Scene
from vsfsim.core.solid import Solid
from vsfsim.data.records import View
from vsfsim.data.streams import Stream
from vsfsim.generate.effects import check_body
from vsfsim.generate.job import Job
from vsfsim.generate.trade.setting import Setting
from vsfsim.physics import tiers
from vsfsim.physics.mesh.edge_refine import EdgePath
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.sensing.camera import look_at, render, seen_by
from vsfsim.sensing.surface import Surface


@dataclass(frozen=True)
class Subject:
    """The object of one view and its picture."""

    job: Job
    """The view to make."""
    scene: Scene
    """The scene of this object."""
    model: Model
    """The object, discretised."""
    view: View
    """Its exact picture, in which touches are aimed and the truth is placed."""
    recorded: View
    """The picture with the camera's errors of depth, which the dataset holds."""

    def stream(self, touch: int) -> np.random.Generator:
        """The random stream that touch number ``touch`` is aimed with."""
        return np.random.default_rng(self.job.stream(Stream.AIM, touch))

    def again(self, setting: Setting, *, edges: EdgePath | None = None) -> Subject:
        """The same object under the same picture, modelled under a setting (see `Job.scene`), with small elements along
        ``edges`` (see `edge_refine`).

        Raises:
            SceneError, MeshError: it cannot be built.
        """
        old = self.job.recipe
        recipe = dataclasses.replace(old, tier=setting.tier, options={**old.options, **setting.table()})
        job = dataclasses.replace(self.job, recipe=recipe)
        scene = job.scene()
        model = tiers.build(scene, setting.tier, seed=job.stream(Stream.BODY), edges=edges)
        return dataclasses.replace(self, job=job, scene=scene, model=model)

    def limits(self) -> SolverOptions:
        """Solver limits of the recipe's tier, with the recipe's own tolerance if its options name one."""
        own, tolerance = tiers.options(self.job.recipe.tier), self.job.recipe.options.get("tolerance")
        return own if tolerance is None else dataclasses.replace(own, tolerance=tolerance)


def prepare(job: Job, *, device: str) -> Subject:
    """Build the object of a view and take its picture.

    Args:
        job: the view.
        device: Warp device.

    Raises:
        SceneError, MeshError: the object cannot be built.
    """
    scene, r = job.scene(), job.recipe
    model = tiers.build(scene, r.tier, seed=job.stream(Stream.BODY))
    check_body(scene, model)
    camera = dataclasses.replace(scene.camera, azimuth=scene.camera.azimuth + 2.0 * np.pi * job.view_index / r.views)
    view = see(surface_of(model.solid, scene), model, camera, device=device, renderer=r.renderer)
    return Subject(job, scene, model, view, seen_by(view, scene.camera, job.stream(Stream.DEPTH)))


def see(surface: Surface, model: Model, camera: CameraSpec, *, device: str, renderer: str) -> View:
    """The picture of a camera that looks at the middle of a body, whose ``surface`` is of `surface_of`."""
    low, high = model.mesh.points.min(axis=0), model.mesh.points.max(axis=0)
    intrinsics, pose = look_at(camera, 0.5 * (low + high))
    return render(surface, intrinsics, pose, camera.width, camera.height, device=device, renderer=renderer)


def surface_of(solid: Solid, scene: Scene) -> Surface:
    """The body's boundary at rest, for the cameras."""
    turn, shift = tiers.placement(scene.required_object)
    triangles, owner = solid.surface()
    return Surface(solid.vertices @ turn.T + shift, triangles, np.asarray(solid.region)[owner],
                   solid.appearance, solid.vertices)
