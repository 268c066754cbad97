"""What a camera's number of pixels costs and misses: the cloud in which touches are aimed, and its normals."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.scene import CameraSpec, SceneFile
from vsfsim.core.text_table import text_table
from vsfsim.data.records import View
from vsfsim.data.streams import Stream
from vsfsim.generate import solid
from vsfsim.generate.cloud import cloud_normals
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants import prepare
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics import tiers

FACTORS = (0.25, 0.5, 1.0, 2.0)
"""On the scene's own width and height [-]."""
FINEST = 4.0
"""Of the picture that stands for the truth [-]."""
PLACES = 1000
"""Points of the finest cloud at which the others are compared."""


@dataclass(frozen=True)
class Picture:
    """One number of pixels."""

    width: int
    height: int
    cpu: float
    """CPU time of the picture [s]."""
    points: int
    """Of the cloud."""
    gap: float
    """Root mean square distance of the visible surface's points from the nearest point of the cloud [m]."""
    normal: float
    """Root mean square angle of the normals there from those of the finest picture [rad]."""


def pictures(loaded: SceneFile, *, seed: int, device: str) -> list[Picture]:
    """The first object of a scene under its camera, with fewer and more pixels.

    Args:
        loaded: with ``[touches]``.
        seed: as of `vsfsim generate`.
        device: Warp device.
    """
    recipe = make_recipe(loaded, seed=seed, objects=1, views=1)
    (job,) = jobs_of(recipe, loaded.path, Path("."), None)
    scene = job.scene()
    if scene.effector == "arm":
        taken: Callable[..., View] = partial(prepare.see, prepare.outline(job).plant)
    else:
        model = tiers.build(scene, recipe.tier, seed=job.stream(Stream.BODY), cache=job.cache)
        taken = partial(solid.see, solid.surface_of(model.solid, scene), model)
    return compared(partial(taken, device=device, renderer=recipe.renderer), scene.camera)


def compared(taken: Callable[[CameraSpec], View], camera: CameraSpec) -> list[Picture]:
    """Pictures with fewer and more pixels beside one with `FINEST` times as many along each side."""
    view = taken(_scaled(camera, FINEST))
    cloud, eye = view.points(), view.camera_pose[:3, 3]
    at = cloud[np.random.default_rng(0).choice(len(cloud), min(PLACES, len(cloud)), replace=False)]
    normals, out = cloud_normals(cloud, at, eye), []
    for factor in FACTORS:
        own = _scaled(camera, factor)
        began = time.process_time()
        found = taken(own).points()
        cpu = time.process_time() - began
        gap = cKDTree(found).query(at)[0]
        cosine = np.clip(np.einsum("ij,ij->i", cloud_normals(found, at, eye), normals), -1.0, 1.0)
        out.append(Picture(own.width, own.height, cpu, len(found), float(np.sqrt(np.mean(gap**2))),
                           float(np.sqrt(np.mean(np.arccos(cosine) ** 2)))))
    return out


def cells(found: Sequence[Picture]) -> tuple[list[str], list[list[str]]]:
    """The head of the table and its rows."""
    return (["pixels", "CPU s", "points", "gap mm", "normal deg"],
            [[f"{p.width} x {p.height}", f"{p.cpu:.3f}", str(p.points), f"{1e3 * p.gap:.2f}",
              f"{math.degrees(p.normal):.1f}"] for p in found])


def text(found: Sequence[Picture]) -> str:
    """The table."""
    return text_table(*cells(found), right=True)


def _scaled(camera: CameraSpec, factor: float) -> CameraSpec:
    return dataclasses.replace(camera, width=max(2, round(factor * camera.width)),
                               height=max(2, round(factor * camera.height)))
