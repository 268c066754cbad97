"""Thickness and place: the features that tell the stiffness of a branching object.

A cantilever's stiffness goes with the fourth power of its thickness and with the inverse cube of its length, so what
vision must tell of a plant is how thick a part is, and how far it is from the stem. `place` has four numbers:

    thickness   diameter of the largest disc in the image that holds the pixel and neither leaves the mask nor crosses
                an edge of the depth (local thickness, Hildebrand and Ruegsegger 1997), as a logarithm of metres
    path        shortest way from the pixel to the foot of the stem through the visible surface [m]
    axis        horizontal distance from the foot of the stem [m]
    height      above the lowest visible point [m]

They are logarithms, since a cantilever's stiffness is a product of powers of them. How deep a particle lies behind the
surface stands beside them.

The foot is the mean of the lowest visible points. The way is the shortest path in a graph of voxels of 10 mm; voxels
that a gap separates are joined at ten times their distance, since a part that hides behind another is not far away.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from vsfsim.data.records import View
from vsfsim.vsf.features.descriptor import depth_and_distance
from vsfsim.vsf.features.interface import FeatureImage, Projection

DEPTH_EDGE = 0.008
"""Step of the depth from one pixel to the next that separates two parts [m]."""
LARGEST = 0.12
"""Largest thickness that is told apart [m]."""
VOXEL = 0.010
"""Edge of a voxel of the surface graph [m]."""
NEAR = 0.05
"""Added to lengths before their logarithm is taken: places this near to the foot are not told apart [m]."""
_NEIGHBOURS = 8
_REACH = 0.025  # voxels further apart are not neighbours on a surface [m]
_GAP = 10.0  # factor on the length of an edge across a gap
_LEAST = 0.02  # of such a length: heights count from the lowest points but 0.2 %, and a leaf may hang far below [m]
_FOOT = 0.03  # points within this height of the lowest one are the foot [m]


class PlaceDescriptor:
    """Logarithms of thickness, way to the foot, distance from it and height, and how deep a particle lies."""

    def image(self, view: View) -> FeatureImage:
        """Dense features, one cell a pixel (H, W, 4)."""
        mask = np.asarray(view.mask, bool)
        values = np.zeros((*mask.shape, 4), np.float32)
        values[mask, 0] = np.log(local_thickness(view)[mask])
        values[mask, 1:] = np.log(np.maximum(place(view) + NEAR, _LEAST))
        visible = values[mask].astype(np.float64)
        token = np.concatenate([visible.mean(axis=0), visible.std(axis=0)]).astype(np.float32)
        return FeatureImage(values, mask, token)

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Logarithms of the depth behind the surface and of the distance to the nearest visible point, as of `local`
        (n, 2)."""
        return depth_and_distance(view, projected)


def local_thickness(view: View) -> np.ndarray:
    """Diameter of the largest disc around or beside each pixel that fits into its part of the image (H, W) [m]; at
    least one pixel inside the mask, 0 outside."""
    mask = np.asarray(view.mask, bool)
    depth = np.where(mask, view.depth, 0.0).astype(float)
    inside = mask.copy()
    for axis in (0, 1):  # of two neighbours across an edge of the depth, the further one is the border of its part
        step = np.diff(depth, axis=axis)
        both = np.logical_and(*(np.take(mask, range(a, mask.shape[axis] - 1 + a), axis=axis) for a in (0, 1)))
        first, second = both & (step < -DEPTH_EDGE), both & (step > DEPTH_EDGE)
        for border, at in ((first, 0), (second, 1)):
            rows, columns = np.nonzero(border)
            inside[rows + at * (axis == 0), columns + at * (axis == 1)] = False
    pixel = np.where(mask, depth / float(view.intrinsics[0, 0]), 0.0)
    # the distance to the nearest pixel outside, less half a pixel: a ribbon of n pixels gets the radius n / 2
    radius = np.maximum(ndimage.distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1] - 0.5, 0.0)
    widest = np.full(mask.shape, 0.5)
    largest = min(float(radius.max(initial=0.0)), 0.5 * LARGEST / max(float(np.median(pixel[mask])), 1e-9))
    for size in np.unique(np.concatenate([np.arange(1.0, 6.0, 0.5), np.geomspace(6.0, max(largest, 6.0), 12)])):
        centres = radius >= size
        if not centres.any():
            break
        widest[ndimage.distance_transform_edt(~centres) < size] = size
    return np.where(mask, 2.0 * widest * pixel, 0.0)


def place(view: View) -> np.ndarray:
    """Way to the foot along the visible surface, horizontal distance from the foot, and height above the lowest point,
    of the k pixels of the mask in row-major order (k, 3) [m]."""
    cloud = view.points()
    low = float(np.quantile(cloud[:, 2], 0.002))
    foot = cloud[cloud[:, 2] <= low + _FOOT].mean(axis=0)
    _, first, voxel = np.unique(np.floor(cloud / VOXEL).astype(int), axis=0, return_index=True, return_inverse=True)
    way = _way(cloud[first], foot)[voxel.ravel()]
    return np.stack([way, np.linalg.norm(cloud[:, :2] - foot[:2], axis=1), cloud[:, 2] - low], axis=1)


def _way(points: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Length of the shortest way from ``foot`` (3,) to each of ``points`` (n, 3) through their graph (n,) [m]."""
    n = len(points)
    count = min(_NEIGHBOURS + 1, n)
    gap, near = cKDTree(points).query(points, k=range(1, count + 1))
    rows, length = np.repeat(np.arange(n), count), np.where(gap > _REACH, _GAP * gap, gap).ravel()
    graph = sparse.coo_matrix((np.maximum(length, 1e-9), (rows, near.ravel())), shape=(n, n)).tocsr()
    graph = graph.maximum(graph.T).tolil()
    number, label = sparse.csgraph.connected_components(graph, directed=False)
    tree, groups = cKDTree(points), [np.flatnonzero(label == c) for c in range(number)]
    start = int(tree.query(foot)[1])
    for group in groups:  # every group of voxels is joined to the nearest voxel of another group
        others = np.flatnonzero(label != label[group[0]])
        if not len(others):
            continue
        across, which = cKDTree(points[others]).query(points[group])
        best = int(np.argmin(across))
        a, b = group[best], others[which[best]]
        graph[a, b] = graph[b, a] = _GAP * across[best]
    found = dijkstra(graph.tocsr(), directed=False, indices=start)
    straight = _GAP * np.linalg.norm(points - foot, axis=1)  # groups that join only one another
    return np.linalg.norm(points[start] - foot) + np.where(np.isfinite(found), found, straight)
