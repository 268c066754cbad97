"""The default features: what a view says about a surface at several metric scales, without anything to download.

`local`, for the tens of training objects there usually are: the mean colour over 8 mm, the energy of three bands of
luminance (texture), and of every
particle its position, depth behind the surface and distance to the nearest visible point: 11 numbers. `local-full` has
everything below. With a dozen shoes to learn from its 32 numbers overfit; with many it has more to say. For every
masked pixel, at scales given in metres (so that the camera's distance does not matter):

    colour      log luminance and two opponent colours, blurred over 3, 8 and 20 mm
    texture     energy of the band between consecutive scales in luminance, and of the opponent colours; how much one
    direction
                dominates (coherence of the structure tensor)
    surface     height, upward and camera-facing component of the normal, mean curvature over 8 and 20 mm, distance to
    the outline

and for every particle its position in the visible box, how deep behind the surface it lies and how far from the nearest
visible point. All blurs are normalised by the blurred mask, so that the background never leaks in.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Geometry, normalised_position

SCALES = (0.003, 0.008, 0.020)
"""Standard deviations of the blurs [m]."""
_CURVATURE_SCALES = (0.008, 0.020)
# Darker than this is black to an 8-bit camera; it keeps the logarithm finite.
_DARKEST = 0.01
# Of the colour channels: luminance and opponents over 8 mm, and the three bands of luminance.
_FEW = (1, 4, 7, 9, 10, 11)
# Depths behind the surface beyond this say no more than "deep" [m].
_DEEPEST = 0.05


class LocalDescriptor:
    """See the module. full: all channels."""

    def __init__(self, *, full: bool = False):
        self.full = full

    def image(self, view: View) -> FeatureImage:
        """Dense features, one cell a pixel (H, W, C)."""
        mask = np.asarray(view.mask, bool)
        pixel_size = float(np.median(view.depth[mask])) / float(view.intrinsics[0, 0])
        channels = _colour(view.rgb, mask, pixel_size)
        channels = [*channels, *_surface(view, mask, pixel_size)] if self.full else [channels[k] for k in _FEW]
        values = np.stack(channels, axis=-1).astype(np.float32)
        seen = values[mask].astype(np.float64)
        return FeatureImage(values, mask, np.concatenate([seen.mean(axis=0), seen.std(axis=0)]).astype(np.float32))

    def of_particles(self, view: View, geometry: Geometry) -> np.ndarray:
        """Position, depth behind the surface and distance to the nearest visible point, both logarithmic; if full,
        height, too (n, 5 or 6)."""
        away = cKDTree(view.points()).query(geometry.points)[0]
        behind = np.clip(geometry.behind, 0.0, _DEEPEST)
        depth = np.log1p(np.stack([behind, away], axis=1) / geometry.spacing)
        return np.concatenate([normalised_position(view, geometry.points), depth,
                               geometry.points[:, 2:][:, : int(self.full)]], axis=1)


class _Blur:
    """Gaussian blur over the mask only; ``sigma`` in pixels."""

    def __init__(self, mask: np.ndarray, sigma: float):
        self.mask, self.sigma = mask.astype(np.float64), max(sigma, 0.3)
        self.weight = np.maximum(ndimage.gaussian_filter(self.mask, self.sigma), 1e-6)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(np.where(self.mask > 0.0, values, 0.0), self.sigma) / self.weight


def _colour(rgb: np.ndarray, mask: np.ndarray, pixel_size: float) -> list[np.ndarray]:
    linear = (rgb.astype(np.float64) / 255.0) ** 2.2
    red, green, blue = np.moveaxis(np.log(linear + _DARKEST), 2, 0)
    # Logarithms turn shading into an offset that the opponent colours do not feel.
    opponents = [(red + green + blue) / 3.0, red - green, 0.5 * (red + green) - blue]
    blurs = [_Blur(mask, scale / pixel_size) for scale in SCALES]
    levels = [[channel, *(blur(channel) for blur in blurs)] for channel in opponents]
    out = [level for channel in levels for level in channel[1:]]
    for channel in levels:
        for fine, coarse, blur in zip(channel[:-1], channel[1:], blurs):
            # Energy of a band, gathered over twice its scale.
            wide = _Blur(mask, 2.0 * blur.sigma)
            out.append(0.5 * np.log(wide((fine - coarse) ** 2) + 1e-5))
    for scale in SCALES[:2]:
        out.append(_coherence(levels[0][0], mask, scale / pixel_size))
    return out


def _coherence(luminance: np.ndarray, mask: np.ndarray, sigma: float) -> np.ndarray:
    """How much one direction dominates the gradients around a pixel, 0 (none) to 1 (stripes)."""
    inner = ndimage.binary_erosion(mask, iterations=2)
    gy, gx = np.gradient(ndimage.gaussian_filter(np.where(mask, luminance, luminance[mask].mean()), 0.7))
    blur = _Blur(inner if inner.any() else mask, 2.0 * sigma)
    xx, yy, xy = blur(gx * gx), blur(gy * gy), blur(gx * gy)
    return np.sqrt((xx - yy) ** 2 + 4.0 * xy**2) / (xx + yy + 1e-6)


def _surface(view: View, mask: np.ndarray, pixel_size: float) -> list[np.ndarray]:
    """Normals, curvature and the distance to the outline, from the depth image."""
    rows, columns = np.indices(mask.shape)
    ray = np.linalg.solve(view.intrinsics, np.stack([columns, rows,
                                                     np.ones_like(rows)]).reshape(3, -1).astype(np.float64))
    out: list[np.ndarray] = []
    depth = view.depth.astype(np.float64)
    # Half a scale wide: less would see the quantised depth, more would round the edges off.
    smooth = _Blur(mask, 0.5 * _CURVATURE_SCALES[0] / pixel_size)(depth)
    points = (ray * smooth.ravel()).reshape(3, *mask.shape)
    down, right = (np.gradient(points, axis=axis) for axis in (1, 2))
    normal = np.cross(right, down, axis=0)
    normal /= np.maximum(np.linalg.norm(normal, axis=0), 1e-12)
    toward = -np.einsum("ikl,ikl->kl", normal, points) / np.maximum(np.linalg.norm(points, axis=0), 1e-9)
    normal, toward = normal * np.sign(toward), np.abs(toward)
    world = np.einsum("ij,jkl->ikl", view.camera_pose[:3, :3], normal)
    height = np.einsum("i,ikl->kl", view.camera_pose[2, :3],
                       (ray * depth.ravel()).reshape(3, *mask.shape)) + view.camera_pose[2, 3]
    out += [height, world[2], toward]
    for scale in _CURVATURE_SCALES:
        # Laplacian of the depth along the view, over the scale: positive on a bump [1/m].
        fine, coarse = _Blur(mask, 0.7 * scale / pixel_size)(depth), _Blur(mask, 1.4 * scale / pixel_size)(depth)
        curvature = (coarse - fine) / scale**2
        out.append(np.sign(curvature) * np.log1p(np.abs(curvature) / 10.0))
    inside = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] * pixel_size
    out.append(np.log1p(inside / SCALES[0]))
    return out
