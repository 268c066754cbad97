"""The surface points that a touch reached: distance from points to a rigid probe along its path."""

from __future__ import annotations

import numpy as np

from vsfsim.core import shape as shapes
from vsfsim.core.chain import Chain
from vsfsim.core.dome import Dome
from vsfsim.core.shape import Capsule, MeshFile, ProbeShape
from vsfsim.data.records import ObjectView

REACH = 0.005
"""A point counts as reached within this distance of the probe [m]: the spacing of the papers' particles on shoes."""
SIMPLE = "touches of a dataset have a simple probe"


def reached(points: np.ndarray, probe: ProbeShape, poses: np.ndarray, *, q: np.ndarray | None = None,
            reach: float = REACH) -> np.ndarray:
    """True where the probe comes within ``reach`` [m] of a point in any frame: (k,) bool.

    Args:
        points: world (k, 3) [m]. probe: its shape. poses: probe-to-world (T, 4, 4) [m]. q: joint angles (T, dof) [rad]
        of an arm, which is reached by all of its capsules.
    """
    out = np.zeros(len(points), bool)
    if not isinstance(probe, Chain):
        _mark(out, points, probe, poses, reach)
        return out
    assert q is not None, "an arm's touch has joint angles"
    at = probe.capsule_poses(probe.links(q))
    for k, c in enumerate(probe.capsules):
        if probe.moves(c.link).any():
            _mark(out, points, Capsule(c.radius, float(np.linalg.norm(np.subtract(c.stop, c.start)))), at[:, k], reach)
    return out


def reached_in(view: ObjectView, points: np.ndarray, *, reach: float = REACH) -> np.ndarray:
    """True where the probe itself comes within ``reach`` [m] of a point (k, 3) [m], world, in some touch: (k,) bool.

    A spring lets the probe give way, so its mount goes deeper than it does. Where the spring's force is unknown, so is
    the place of the probe: such a frame reaches nothing.
    """
    near = np.zeros(len(points), bool)
    for touch in view.touches:
        left = np.flatnonzero(~near)
        known = np.isfinite(touch.force).all(axis=1) if touch.mount_stiffness is not None else slice(None)
        near[left] = reached(points[left], view.probe_of(touch), touch.probe_pose()[known],
                             q=None if touch.q is None else touch.q[known], reach=reach)
    return near


def _mark(out: np.ndarray, points: np.ndarray, probe: ProbeShape, poses: np.ndarray, reach: float) -> None:
    """Set ``out`` where the probe comes near. Only points in a ball about the probe are measured: an arm has a dozen
    capsules, most of them far from the object in every frame, and most points are far from any path."""
    assert not isinstance(probe, MeshFile | Chain), SIMPLE
    ball = 1.001 * (shapes.reach(probe) + 2.0 * reach)
    at = poses[:, :3, 3]
    low, high = at.min(axis=0, initial=np.inf) - ball, at.max(axis=0, initial=-np.inf) + ball
    inside = np.flatnonzero(~out & ((points >= low) & (points <= high)).all(axis=1))
    if not len(inside):
        return
    middle = points[inside].mean(axis=0)
    own, at = points[inside] - middle, at - middle
    away = (at**2).sum(axis=1)[:, None] + (own**2).sum(axis=1) - 2.0 * at @ own.T  # squared distances (T, k)
    for pose, near in zip(poses, away <= ball**2, strict=True):
        left = inside[near]
        left = left[~out[left]]
        if len(left):
            out[left] = distance((points[left] - pose[:3, 3]) @ pose[:3, :3], probe) <= reach


def distance(local: np.ndarray, probe: ProbeShape) -> np.ndarray:
    """Distance (k,) [m] from points (k, 3) [m] in the probe's frame to its solid; 0 or negative inside."""
    if isinstance(probe, Dome):
        return _from_dome(local, probe)
    assert not isinstance(probe, MeshFile | Chain), SIMPLE
    return shapes.distance(probe, local)


def _from_dome(local: np.ndarray, dome: Dome) -> np.ndarray:
    """To its nearest vertex, negative under the skin; one farther than twice `REACH` outside its bounding box is not
    measured: infinite."""
    out = np.full(len(local), np.inf)
    low, high = dome.points.min(axis=0) - 2.0 * REACH, dome.points.max(axis=0) + 2.0 * REACH
    near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
    if not len(near):
        return out
    at = local[near]
    away = dome.to_vertices(at)
    beside = np.flatnonzero((at[:, 2] >= 0.0) & (at[:, 2] <= dome.height))  # the others are over or behind the skin
    under = beside[at[beside, 2] <= dome.heights(at[beside, :2])]
    away[under] *= -1.0
    out[near] = away
    return out
