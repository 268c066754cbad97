"""The pose of a known stiff object, for methods that estimate stiffness (Neural VSF section III-E).

The papers register the object's surface to the stiff points (`vsfsim.vsf.pose.localise`). On the training objects of
localization-mini-v1 that turns most objects upside down, while the outline of the stiff columns
(`vsfsim.vsf.pose.outline`) finds the angle within a few degrees. docs/methods.md has both figures.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.visible_cloud import visible_cloud
from vsfsim.bench.method import Reading
from vsfsim.bench.reached_points import reached
from vsfsim.core.errors import VsfError
from vsfsim.data.records import View
from vsfsim.vsf.pose.localise import KnownObject
from vsfsim.vsf.pose.outline import outline_pose

STEP = 0.003
"""Edge of a column, and distance of the points at which a continuous field is evaluated [m]."""


@dataclass(frozen=True)
class PoseSearch:
    """Settings of the search for a known object."""

    cover: float = 0.004
    """Assumed depth of the object's upper side under the touched surface [m], which touch determines poorly."""
    turned: bool = False
    """The object may lie on its other face; the training objects do not."""
    refine: int = 400
    """Steps of the random search."""
    seed: int = 0
    """Of the search."""


def locate(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, stiffness: np.ndarray, view: View,
           settings: PoseSearch) -> np.ndarray:
    """Object-to-world transform (4, 4) of a known object from the stiffness at touched points (n, 3) [m], (n,).

    Where the points are too few, or all of one stiffness, the object is upright at the centre of the visible cloud.

    Raises:
        MethodError: the view shows no object.
    """
    cloud = visible_cloud(view)
    top = float(np.quantile(cloud[:, 2], 0.9)) - settings.cover
    cell = np.floor(points[:, :2] / STEP).astype(int).reshape(-1, 2)
    columns, index = np.unique(cell, axis=0, return_inverse=True)
    stiffest = np.zeros(len(columns))
    np.maximum.at(stiffest, index.ravel(), np.asarray(stiffness, float))
    area = len(np.unique(np.floor(cloud[:, :2] / STEP).astype(int), axis=0)) * STEP**2
    try:
        known = _known(_hashable(vertices, float), _hashable(triangles, np.int64))
        return outline_pose(known, (columns + 0.5) * STEP, stiffest, area=area, top=top, turned=settings.turned,
                          refine=settings.refine, seed=settings.seed).transform
    except VsfError:
        out = np.eye(4)
        out[:3, 3] = cloud.mean(axis=0)
        return out


@functools.lru_cache(maxsize=16)
def _known(vertices: tuple[tuple[int, ...], bytes], triangles: tuple[tuple[int, ...], bytes]) -> KnownObject:
    # The same object is located at every shot and seed, and its inside test takes seconds to build.
    return KnownObject.of(np.frombuffer(vertices[1], float).reshape(vertices[0]),
                          np.frombuffer(triangles[1], np.int64).reshape(triangles[0]))


def _hashable(array: np.ndarray, kind: type) -> tuple[tuple[int, ...], bytes]:
    return np.shape(array), np.ascontiguousarray(array, kind).tobytes()


def touched_points(view: View, support: Sequence[Reading], *, depth: float) -> np.ndarray:
    """Grid points (n, 3) [m] from the visible surface down to ``depth`` [m], where a touch of the support came near."""
    cloud = visible_cloud(view)
    _, first = np.unique(np.floor(cloud[:, :2] / STEP).astype(int), axis=0, return_index=True)
    top = cloud[first]
    near = np.zeros(len(top), bool)
    for reading in support:
        if reading.surface is not None:
            away, index = cKDTree(top).query(reading.surface.vertices[-1])
            near[np.unique(index[away < 4.0 * STEP])] = True
        else:
            near |= reached(top, reading.action.probe, reading.action.poses, reach=STEP)
    down = np.arange(0.5 * STEP, depth, STEP)
    return (top[near, None] - down[:, None] * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)
