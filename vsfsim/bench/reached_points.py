"""The surface points that a touch reached: distance from points to a rigid probe along its path."""

from __future__ import annotations

import numpy as np

from vsfsim.core import signed_distance
from vsfsim.core.chain import Chain
from vsfsim.core.dome import Dome
from vsfsim.core.shape import Capsule, MeshFile, ProbeShape

REACH = 0.005
"""A point counts as reached within this distance of the probe [m]: the spacing of the papers' particles on shoes."""


def reached(points: np.ndarray, probe: ProbeShape, poses: np.ndarray, *, q: np.ndarray | None = None,
            reach: float = REACH) -> np.ndarray:
    """True where the probe comes within ``reach`` [m] of a point in any frame: (k,) bool.

    Args:
        points: world (k, 3) [m]. probe: its shape. poses: probe-to-world (T, 4, 4) [m]. q: joint angles (T, dof) [rad]
        of an arm, which is reached by all of its capsules.
    """
    if isinstance(probe, Chain):
        assert q is not None, "an arm's touch has joint angles"
        at, out = probe.capsule_poses(probe.links(q)), np.zeros(len(points), bool)
        for k, c in enumerate(probe.capsules):
            if probe.moves(c.link).any():
                out |= reached(points, Capsule(c.radius, float(np.linalg.norm(np.subtract(c.stop, c.start)))), at[:, k],
                               reach=reach)
        return out
    out = np.zeros(len(points), bool)
    for pose in poses:
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        out |= distance(local, probe) <= reach
    return out


def distance(local: np.ndarray, probe: ProbeShape) -> np.ndarray:
    """Distance (k,) [m] from points (k, 3) [m] in the probe's frame to its solid; 0 or negative inside."""
    if isinstance(probe, Dome):
        return _from_dome(local, probe)
    assert not isinstance(probe, MeshFile | Chain), "touches of a dataset have a simple probe"
    return signed_distance.distance(probe, local)


def _from_dome(local: np.ndarray, dome: Dome) -> np.ndarray:
    """To its nearest vertex, negative under the skin; one farther than twice `REACH` outside its bounding box is not
    measured: infinite."""
    out = np.full(len(local), np.inf)
    low, high = dome.points.min(axis=0) - 2.0 * REACH, dome.points.max(axis=0) + 2.0 * REACH
    near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
    if not len(near):
        return out
    away = np.sqrt(((local[near, None] - dome.points[None]) ** 2).sum(axis=2)).min(axis=1)
    under = (local[near, 2] >= 0.0) & (local[near, 2] <= dome.heights(local[near, :2]))
    out[near] = np.where(under, -away, away)
    return out
