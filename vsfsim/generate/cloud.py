"""The visible point cloud of an object: normals and an even sample of it."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 40  # points of the cloud that a normal is fitted to
_RADIUS = 0.012  # and how far away they may be [m]


def cloud_normals(cloud: np.ndarray, at: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Outward unit normals (k, 3) of a point cloud (n, 3) [m] at ``at`` (k, 3): the direction of least variance of the
    neighbours.

    Args:
        eye: the camera's centre (3,) [m]; a visible surface faces it.
    """
    tree = cKDTree(cloud)
    distance, index = tree.query(at, k=min(_NEIGHBOURS, len(cloud)), distance_upper_bound=_RADIUS)
    out = np.empty_like(at)
    for i in range(len(at)):
        near = cloud[index[i][np.isfinite(distance[i])]]
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][-1] if len(near) >= 3 else eye - at[i]
        normal = normal / np.linalg.norm(normal)
        out[i] = normal if normal @ (eye - at[i]) >= 0 else -normal
    return out


def voxel_sample(cloud: np.ndarray, size: float) -> np.ndarray:
    """One point of the cloud (n, 3) [m] for every occupied voxel of edge ``size`` [m]: the one nearest to the mean of
    the voxel's points (k, 3) [m]."""
    cell = np.floor(cloud / size).astype(np.int64)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, cloud[:, c]) / count for c in range(3)], axis=1)
    off = np.linalg.norm(cloud - mean[group], axis=1)
    order = np.lexsort((np.arange(len(cloud)), off, group))
    return cloud[order[np.unique(group[order], return_index=True)[1]]]
