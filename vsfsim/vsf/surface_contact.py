"""Where a rigid probe or a dome comes closest to the visible surface, and how far past it; without particles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.core.dome import Dome
from vsfsim.core.shape import Plane, ProbeShape
from vsfsim.physics.contact import sdf

_MARGIN = 0.02  # points further from the way of the probe than this are never the closest of a touch that meets [m]


@dataclass(frozen=True)
class SurfaceContact:
    """A touch, seen from the surface."""

    place: np.ndarray
    """The visible point that the probe passes deepest (3,) [m]."""
    depth: np.ndarray
    """How far the probe is past the visible surface in each frame, 0 where it is clear of it (T,) [m]."""


def surface_contact(cloud: np.ndarray, poses: np.ndarray, probe: ProbeShape) -> SurfaceContact:
    """The contact of a ``probe`` at ``poses`` (T, 4, 4) [m] with a visible ``cloud`` (k, 3) [m], k > 0. The depth under
    a dome is that along its axis."""
    near = cloud
    if not isinstance(probe, Plane):
        low, high = poses[:, :3, 3].min(axis=0), poses[:, :3, 3].max(axis=0)
        away = np.linalg.norm(np.maximum(np.maximum(low - cloud, cloud - high), 0.0), axis=1)
        within = away < sdf.reach(probe) + _MARGIN
        near = cloud[within] if within.any() else cloud
    distance = np.stack([_distance(probe, (near - pose[:3, 3]) @ pose[:3, :3]) for pose in poses])
    return SurfaceContact(near[distance.min(axis=0).argmin()], np.maximum(-distance.min(axis=1), 0.0))


def _distance(probe: ProbeShape, local: np.ndarray) -> np.ndarray:
    """Of points (k, 3) [m] in the probe's frame, negative inside (k,) [m]."""
    if not isinstance(probe, Dome):
        return sdf.distance(probe, local)
    out = probe.to_vertices(local)
    over = local[:, 2] - probe.heights(local[:, :2])  # infinite outside the rim
    under = (local[:, 2] >= 0.0) & (over < 0.0)  # and in front of the rim plane
    out[under] = over[under]
    return out
