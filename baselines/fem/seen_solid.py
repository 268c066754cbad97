"""A solid from one view: what lies behind the visible surface, above the ground and under what is seen of the top."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from vsfsim.baselines.visible_cloud import visible_cloud
from vsfsim.core.errors import MethodError
from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.data.records import View
from vsfsim.physics.mesh.lattice import fill_lattice
from vsfsim.physics.mesh.validity import body_of_each_tet, drop_pinches

_CELL = 0.003  # edge of the columns whose tops are looked at [m]
_CLOSE = 27  # columns over which gaps between the seen ones are closed: a near wall hides what is behind it
_SMOOTH = 5  # pixels of the median that takes the camera's noise off
_GROUND = 0.005  # share of the cloud that noise may put below the ground [-]
_LEAST = 20  # tetrahedra of a solid


def seen_solid(view: View, size: float) -> Solid:
    """The solid of the object in a view, world, standing on z = 0, or as high as its lowest points where those are
    higher than the object is long.

    A point is inside if the camera sees the surface in front of it, if it is above the ground, and if it is lower than
    the highest point that is seen in its column. What the camera does not see from above is left out.

    Args:
        view: the object at rest.
        size: of its tetrahedra [m].

    Raises:
        MethodError: the view shows too little for a solid.
    """
    cloud = visible_cloud(view)
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    lowest = float(np.quantile(cloud[:, 2], _GROUND))
    ground = lowest if lowest > float(np.ptp(cloud[:, :2], axis=0).max()) else min(lowest, 0.0)
    low[2] = ground
    shape = np.ceil((high[:2] - low[:2]) / _CELL).astype(int) + 1
    tops = np.full(shape, -np.inf)
    column = np.floor((cloud[:, :2] - low[:2]) / _CELL).astype(int)
    np.maximum.at(tops, (column[:, 0], column[:, 1]), cloud[:, 2])
    tops = ndimage.grey_closing(np.pad(tops, _CLOSE, constant_values=-1e3).clip(min=-1e3), size=_CLOSE)
    mask = np.asarray(view.mask, bool)
    nearest = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    depth = ndimage.median_filter(np.asarray(view.depth, float)[tuple(nearest)], size=_SMOOTH)
    depth = np.where(mask, depth, np.inf)
    turn, eye, intrinsics = view.camera_pose[:3, :3], view.camera_pose[:3, 3], view.intrinsics

    def level(points: np.ndarray) -> np.ndarray:
        at = (points - eye) @ turn
        pixel = np.round((at @ intrinsics.T)[:, :2] / np.maximum(at[:, 2:], 1e-9)).astype(int)
        row, col = pixel[:, 1].clip(0, mask.shape[0] - 1), pixel[:, 0].clip(0, mask.shape[1] - 1)
        cell = np.floor((points[:, :2] - low[:2]) / _CELL).astype(int) + _CLOSE
        i, j = cell[:, 0].clip(0, tops.shape[0] - 1), cell[:, 1].clip(0, tops.shape[1] - 1)
        hidden = at[:, 2] > depth[row, col]
        return np.where(hidden & (points[:, 2] > ground) & (points[:, 2] < tops[i, j]), -1.0, 1.0)

    if not (high > low).all():
        raise MethodError("the view shows no solid: its visible points lie on a line.")
    vertices, tets = fill_lattice(level, low, high, size)
    if len(tets):
        body = body_of_each_tet(tets)
        largest = np.bincount(body, weights=tet_volumes(vertices, tets)).argmax()
        kept = drop_pinches(vertices, tets[body == largest])
        tets = tets[:0] if kept is None else kept
    if len(tets) < _LEAST:
        raise MethodError(f"the view shows too little for a solid of elements of {1e3 * size:g} mm: {len(tets)} "
                          f"tetrahedra, and {_LEAST} are needed. Give a smaller size.")
    used, tets = np.unique(tets, return_inverse=True)
    return Solid(vertices[used], tets.reshape(-1, 4), np.zeros(tets.size // 4, np.int64), ("seen",))
