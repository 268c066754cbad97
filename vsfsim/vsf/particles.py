"""The particles of a VSF from one RGB-D view: ray casting into the occluded volume (SBML appendix B.2).

A point of a regular grid belongs to the object if the camera's ray to it passes through the object's mask and reaches
the observed surface no later than the point. These are the visible surface and the volume behind it, within the bounds.
"""

import math

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.errors import VsfError
from vsfsim.data.records import View

# The caller that shows progress reports compilation, so Warp's own messages are off.
if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING
wp.set_module_options({"enable_backward": False})

_MAX_GRID = 50_000_000


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
                        max_particles: int | None = None, seed: int = 0, device: str = "cpu",
                        tolerance: float = 0.0) -> np.ndarray:
    """Grid points on or behind the visible surface (n, 3) float64, world [m], in z, then y, then x order.

    Args:
        view: depth, mask and camera.
        bounds: lower and upper corner of the volume, world (2, 3) [m]; None: `bounds_from_view`.
        spacing: edge of a grid cell [m]; the papers use 5 mm for shoes and 10 mm for plants. Points are cell centres.
        max_particles: greatest number of points to keep, drawn uniformly without replacement; None for all.
        seed: of that draw; an integer >= 0.
        device: Warp device.
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
    if max_particles is not None and max_particles < 1:
        raise VsfError(f"vsf.particles: max_particles is {max_particles!r}; it must be at least 1, or None for all.")
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
    world_to_camera = np.linalg.inv(np.asarray(view.camera_pose, np.float64))
    with wp.ScopedDevice(device):
        keep = wp.zeros(shape[::-1], dtype=wp.bool)
        wp.launch(_behind, dim=shape[::-1], inputs=[
            wp.vec3d(*first), wp.float64(spacing), wp.float64(tolerance),
            wp.mat33d(np.asarray(view.intrinsics, np.float64)),
            wp.mat33d(world_to_camera[:3, :3]), wp.vec3d(*world_to_camera[:3, 3]),
            wp.array(np.where(view.mask, view.depth, 0.0).astype(np.float32), dtype=wp.float32),
        ], outputs=[keep])
        inside = keep.numpy()
    points = first + spacing * np.argwhere(inside)[:, ::-1]
    if max_particles is not None and len(points) > max_particles:
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        points = points[np.sort(rng.choice(len(points), max_particles, replace=False))]
    return points


@wp.kernel(enable_backward=False)
def _behind(
    # model
    first: wp.vec3d,
    spacing: wp.float64,
    tolerance: wp.float64,
    intrinsics: wp.mat33d,
    rotation: wp.mat33d,
    translation: wp.vec3d,
    # state in
    depth_in: wp.array2d(dtype=wp.float32),
    # state out
    keep_out: wp.array3d(dtype=wp.bool),
):
    k, j, i = wp.tid()
    p = rotation * (first + spacing * wp.vec3d(wp.float64(i), wp.float64(j), wp.float64(k))) + translation
    if p[2] <= wp.float64(0.0):
        return
    on_image = intrinsics * (p / p[2])
    column = int(wp.rint(on_image[0]))
    row = int(wp.rint(on_image[1]))
    if row < 0 or column < 0 or row >= depth_in.shape[0] or column >= depth_in.shape[1]:
        return
    surface = wp.float64(depth_in[row, column])
    if surface > wp.float64(0.0) and p[2] >= surface - tolerance:
        keep_out[k, j, i] = True
