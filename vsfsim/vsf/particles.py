"""The particles of a VSF from one RGB-D view: ray casting into the occluded volume (SBML appendix B.2).

A point of a regular grid belongs to the object if the camera's ray to it passes through the object's mask and reaches
the observed surface no later than the point. These are the visible surface and the volume behind it, within the bounds.
"""

import math

import numpy as np

from vsfsim.core.errors import VsfError
from vsfsim.data.records import View

_MAX_GRID = 50_000_000
_TOGETHER = 1_000_000  # grid points that are looked at together


def bounds_from_view(view: View, *, margin: float = 0.02) -> np.ndarray:
    """A box around the visible cloud, standing on the table.

    Args:
        view: with at least one pixel on the object.
        margin: added on every side except below z = 0, where the table is [m]. The hidden part of the object is
            assumed to extend no further than this beyond the visible part.

    Returns:
        Lower and upper corner, world (2, 3) [m].

    Raises:
        VsfError: nothing is visible, or the margin is not a length.
    """
    cloud = view.points()
    if len(cloud) == 0:
        raise VsfError("vsf.bounds_from_view: the view's mask is empty; point the camera at the object, or give "
                       "the bounds.")
    if not 0.0 <= margin < math.inf:
        raise VsfError(f"vsf.bounds_from_view: margin is {margin!r}; it must be a length in metres, 0 or more.")
    bounds = np.stack([cloud.min(axis=0) - margin, cloud.max(axis=0) + margin])
    # The object stands on the table: its hidden part may extend down to z = 0 and no further.
    bounds[0, 2] = 0.0 if bounds[0, 2] < 0.0 or cloud[:, 2].min() > 0.0 else bounds[0, 2]
    bounds[1, 2] = max(bounds[1, 2], 0.0)
    return bounds


def particles_from_view(view: View, *, bounds: np.ndarray | None = None, spacing: float = 0.005,
                        tolerance: float = 0.0) -> np.ndarray:
    """Grid points on or behind the visible surface (n, 3) float64, world [m], in z, then y, then x order.

    Args:
        view: depth, mask and camera.
        bounds: lower and upper corner of the volume, world (2, 3) [m]; None: `bounds_from_view`.
        spacing: edge of a grid cell [m]; the papers use 5 mm for shoes and 10 mm for plants. Points are cell centres.
        tolerance: distance in front of the observed surface within which a point still belongs [m].

    Raises:
        VsfError: the bounds are reversed or not finite, the spacing is not a length, or the grid has over 5e7 points.
    """
    bounds = bounds_from_view(view) if bounds is None else np.asarray(bounds, np.float64)
    if bounds.shape != (2, 3) or not np.isfinite(bounds).all() or not (bounds[1] > bounds[0]).all():
        raise VsfError(f"vsf.particles: bounds are {bounds.tolist()}; give the lower and the upper corner, (2, "
                       f"3) in metres.")
    if not 0.0 < spacing < math.inf:
        raise VsfError(f"vsf.particles: spacing is {spacing!r}; it must be a length in metres greater than 0, "
                       f"e.g. 0.005.")
    # At least one cell an axis, and the grid is centred in the bounds. The 1e-9 makes 0.1 / 0.005 give 20 cells.
    count = np.maximum(np.floor((bounds[1] - bounds[0]) / spacing + 1e-9), 1.0)
    if count.prod() > _MAX_GRID:
        raise VsfError(
            f"vsf.particles: a spacing of {spacing:g} m makes {count.prod():.2g} grid points in a volume of "
            f"{' x '.join(f'{s:.3g}' for s in bounds[1] - bounds[0])} m; at most {_MAX_GRID:.0e}. Is the "
            f"spacing in metres?"
        )
    shape = tuple(int(c) for c in count)
    first = 0.5 * (bounds[0] + bounds[1]) - 0.5 * (count - 1) * spacing
    parts = []
    for start in range(0, math.prod(shape), _TOGETHER):
        number = np.arange(start, min(start + _TOGETHER, math.prod(shape)))
        grid = first + spacing * np.stack(np.unravel_index(number, shape[::-1])[::-1], axis=1)
        behind = behind_surface(view, grid)[1]
        parts.append(grid[np.isfinite(behind) & (behind >= -tolerance)])
    return np.concatenate(parts)


def behind_surface(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (column, row) (n, 2) [px] of world points (n, 3) [m], and how far these lie behind the visible surface
    along the optical axis (n,) [m], infinite where the pixel shows no object."""
    world_to_camera = np.linalg.inv(np.asarray(view.camera_pose, np.float64))
    local = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (local / local[:, 2:]) @ view.intrinsics.T[:, :2]
    pixel = np.where(local[:, 2:] > 0.0, pixel, -1e9)
    column, row = np.rint(pixel).astype(np.int64).T
    height, width = view.mask.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    hit = inside & view.mask[row, column] & (view.depth[row, column] > 0.0)
    return pixel, np.where(hit, local[:, 2] - view.depth[row, column], np.inf)
