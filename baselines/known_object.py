"""The pose of a known stiff object, for methods that estimate stiffness (Neural VSF section III-E).

The papers register the object's surface to the stiff points, in all six degrees of freedom
(`vsfsim.vsf.pose.stiffness_pose`; ``pose="registration"`` of a method). On the training objects of
localization-mini-v1 that turns most objects upside down, while the outline of the stiff columns
(`vsfsim.vsf.pose.outline_pose`) finds the angle within a few degrees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.visible_cloud import digest, visible_cloud
from vsfsim.bench.inclusions import reached
from vsfsim.bench.method import Reading
from vsfsim.core.errors import MethodError, VsfError, did_you_mean
from vsfsim.data.records import View

if TYPE_CHECKING:  # it starts Warp, and with it the driver of a GPU, which a fork could no longer use
    from vsfsim.vsf.pose import KnownObject

POSES = ("outline", "registration")
"""How a known object is found: by the outline of the stiff columns, or by the papers' procedure."""

COVER_FACTOR = 2.0
"""The papers' threshold is "greater than the cover stiffness": this many times the median of the touched points, most
of which are in the cover [-]."""

STEP = 0.003
"""Edge of a column, and distance of the points at which a continuous field is evaluated [m]."""


@dataclass(frozen=True)
class PoseSearch:
    """Settings of the search for a known object."""

    cover: float = 0.004
    """Assumed depth of the object's upper side under the touched surface [m], which touch determines poorly."""
    refine: int = 400
    """Steps of the random search."""
    seed: int = 0
    """Of the search."""
    pose: str = "outline"
    """One of `POSES`."""

    def __post_init__(self) -> None:
        if self.pose not in POSES:
            raise MethodError(f"pose is '{self.pose}'. {did_you_mean(self.pose, POSES)}")


def locate(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, stiffness: np.ndarray, view: View,
           settings: PoseSearch) -> np.ndarray:
    """Object-to-world transform (4, 4) of a known object from the stiffness at touched points (n, 3) [m], (n,).

    Where the points are too few, or all of one stiffness, the object is upright at the centre of the visible cloud.

    Raises:
        MethodError: the view shows no object.
    """
    from vsfsim.vsf.pose import outline_pose, stiffness_pose

    cloud = visible_cloud(view)
    upright = np.eye(4)
    upright[:3, 3] = cloud.mean(axis=0)
    stiffness = np.asarray(stiffness, float)
    if settings.pose == "registration":
        try:
            return stiffness_pose(_known(vertices, triangles), points, stiffness,
                                  threshold=COVER_FACTOR * float(np.median(stiffness)) if len(stiffness) else 0.0,
                                  seed=settings.seed).transform
        except VsfError:
            return upright
    top = float(np.quantile(cloud[:, 2], 0.9)) - settings.cover
    cell = np.floor(points[:, :2] / STEP).astype(int).reshape(-1, 2)
    columns, index = np.unique(cell, axis=0, return_inverse=True)
    stiffest = np.zeros(len(columns))
    np.maximum.at(stiffest, index.ravel(), stiffness)
    area = len(np.unique(np.floor(cloud[:, :2] / STEP).astype(int), axis=0)) * STEP**2
    try:
        return outline_pose(_known(vertices, triangles), (columns + 0.5) * STEP, stiffest, area=area, top=top,
                            refine=settings.refine, seed=settings.seed).transform
    except VsfError:
        return upright


_KNOWN: dict[bytes, KnownObject] = {}
"""By the digest of their meshes: the same object is located at every shot and seed, and its inside test takes seconds
to build."""


def _known(vertices: np.ndarray, triangles: np.ndarray) -> KnownObject:
    from vsfsim.vsf.pose import KnownObject

    key = digest(vertices, triangles)
    if key not in _KNOWN:
        _KNOWN[key] = KnownObject.of(vertices, triangles)
    return _KNOWN[key]


def touched_points(view: View, support: Sequence[Reading], *, depth: float) -> np.ndarray:
    """Grid points (n, 3) [m] from the visible surface down to ``depth`` [m], where a touch of the support came near."""
    cloud = visible_cloud(view)
    _, first = np.unique(np.floor(cloud[:, :2] / STEP).astype(int), axis=0, return_index=True)
    top = cloud[first]
    near = np.zeros(len(top), bool)
    for reading in support:
        if reading.surface is not None:
            made = np.isfinite(reading.surface.vertices).all(axis=(1, 2))
            if not made.any():
                continue
            # the last frame whose surface is known: one without an equilibrium has none
            away, index = cKDTree(top).query(reading.surface.vertices[np.flatnonzero(made)[-1]])
            near[np.unique(index[away < 4.0 * STEP])] = True
        else:
            near |= reached(top, reading.action.probe, reading.action.poses, reach=STEP)
    down = np.arange(0.5 * STEP, depth, STEP)
    return (top[near, None] - down[:, None] * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
