"""Where a known stiff object lies, for methods that estimate stiffness (Neural VSF section III-E), with the settings that all of them share.

The threshold of eq. 7 must lie above the cover's stiffness, which differs from object to object: it is where the logarithms of the touched points'
stiffnesses fall best into two classes (Otsu 1979). Defaults were chosen on the training objects of localization-mini-v1, see docs/methods.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.bench.method import Reading
from vsfsim.bench.metrics import stiff_points
from vsfsim.bench.reached import reached
from vsfsim.data.records import View
from vsfsim.vsf.dynamics import VsfError
from vsfsim.vsf.localise import KnownObject, contact_pose, stiffness_pose

STEP = 0.003
"""Distance of the points at which a continuous field is asked [m]."""


@dataclass(frozen=True)
class Locating:
    """Settings. tries: registrations of which the best is kept. refine: steps of the search on the loss. lift: of the threshold over the cut of
    the two classes [-]. seed: of the draws."""

    tries: int = 6
    refine: int = 300
    lift: float = 1.0
    seed: int = 0


def locate_stiff(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, stiffness: np.ndarray, settings: Locating) -> np.ndarray:
    """Object-to-world transform (4, 4) of a known object from the stiffness at touched points (n, 3) [m], (n,).

    With fewer than 10 points in the stiff class nothing can be registered: the object then stands upright in their middle.
    """
    positive = stiffness > 0.0
    if positive.sum() >= 20:
        points, stiffness = points[positive], stiffness[positive]
        stiff = stiff_points(stiffness)
        if stiff.any() and not stiff.all():
            cut = settings.lift * float(np.sqrt(stiffness[stiff].min() * stiffness[~stiff].max()))
            try:
                return stiffness_pose(KnownObject.of(vertices, triangles), points, stiffness, threshold=cut, tries=settings.tries, refine=settings.refine, seed=settings.seed).transform
            except VsfError:
                pass
    return _upright(points)


def locate_contacts(vertices: np.ndarray, triangles: np.ndarray, contacts: np.ndarray, settings: Locating) -> np.ndarray:
    """The same from contact points (n, 3) [m] alone, without a stiffness."""
    if len(contacts) < 10:
        return _upright(contacts)
    return contact_pose(KnownObject.of(vertices, triangles), contacts, tries=settings.tries, seed=settings.seed).transform


def touched_points(view: View, support: list[Reading], *, depth: float) -> np.ndarray:
    """Grid points (n, 3) [m] from the seen surface down to ``depth`` [m] where some touch of the support came near."""
    cloud = view.points()
    cell = np.floor(cloud[:, :2] / STEP).astype(int)
    _, first = np.unique(cell, axis=0, return_index=True)
    top = cloud[first]
    near = np.zeros(len(top), bool)
    for reading in support:
        if reading.surface is not None:
            deepest = reading.surface.vertices.reshape(-1, 3)
            away = cKDTree(top).query(deepest[::7])
            near[np.unique(away[1][away[0] < 2.0 * STEP])] = True
        else:
            near |= reached(top, reading.action.probe, reading.action.poses, reach=STEP)
    down = np.arange(0.5 * STEP, depth, STEP)
    return (top[near, None] - down[:, None] * np.array([0.0, 0.0, 1.0])).reshape(-1, 3)


def _upright(points: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    if len(points):
        out[:3, 3] = points.mean(axis=0)
    return out
