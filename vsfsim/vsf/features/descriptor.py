"""The default features: what a view shows of a surface at several metric scales, without anything to download.

`local` is for the tens of training objects that there usually are. It has 11 numbers: the mean colour over 8 mm, the
energy of three bands of luminance (texture), and for every particle its position, its depth behind the surface and its
distance to the nearest visible point. `local-full` has everything below; with a dozen shoes to learn from, its 32
numbers overfit. Scales are in metres, so that the distance of the camera does not matter:

    colour      log luminance and two opponent colours, blurred over 3, 8 and 20 mm
    texture     energy of the band between consecutive scales in luminance and in the opponent colours; coherence of
                the structure tensor (how much one direction dominates)
    surface     height, upward and camera-facing component of the normal, mean curvature over 8 and 20 mm, distance to
                the outline

Every particle also has its position in the visible box, its depth behind the surface and its distance to the nearest
visible point. All blurs are normalised by the blurred mask, so that the background has no influence.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Projection, normalised_position

SCALES = (0.003, 0.008, 0.020)
"""Standard deviations of the blurs [m]."""
_CURVATURE_SCALES = (0.008, 0.020)
# Darker than this is black to an 8-bit camera; it keeps the logarithm finite.
_DARKEST = 0.01
# Depths behind the surface are clipped here: deeper particles do not differ for touch [m].
_DEEPEST = 0.05


class LocalDescriptor:
    """The module's features.

    Args:
        full: all channels of `local-full`; else those of `local`.
    """

    def __init__(self, *, full: bool = False):
        self.full = full

    def image(self, view: View) -> FeatureImage:
        """Dense features, one cell a pixel (H, W, C)."""
        mask = np.asarray(view.mask, bool)
        pixel_size = float(np.median(view.depth[mask])) / float(view.intrinsics[0, 0])
        channels = _colour(view.rgb, mask, pixel_size, full=self.full)
        if self.full:
            channels += _surface(view, mask, pixel_size)
        values = np.stack(channels, axis=-1).astype(np.float32)
        visible = values[mask].astype(np.float64)
        token = np.concatenate([visible.mean(axis=0), visible.std(axis=0)])
        return FeatureImage(values, mask, token.astype(np.float32))

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Position, logarithms of the depth behind the surface and of the distance to the nearest visible point, and
        in the full descriptor the height (n, 5 or 6)."""
        height = projected.points[:, 2:][:, : int(self.full)]
        return np.concatenate([normalised_position(view, projected.points), depth_and_distance(view, projected),
                               height], axis=1)


def depth_and_distance(view: View, projected: Projection) -> np.ndarray:
    """Logarithms of the particles' depth behind the surface and of their distance to the nearest visible point, over
    their spacing (n, 2) [-]."""
    away = cKDTree(view.points()).query(projected.points)[0]
    behind = np.clip(projected.behind, 0.0, _DEEPEST)
    return np.log1p(np.stack([behind, away], axis=1) / projected.spacing)


class _Blur:
    """Gaussian blur over the mask only; ``sigma`` in pixels."""

    def __init__(self, mask: np.ndarray, sigma: float):
        self.mask, self.sigma = mask.astype(np.float64), max(sigma, 0.3)
        self.weight = np.maximum(ndimage.gaussian_filter(self.mask, self.sigma), 1e-6)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(np.where(self.mask > 0.0, values, 0.0), self.sigma) / self.weight


def _colour(rgb: np.ndarray, mask: np.ndarray, pixel_size: float, *, full: bool) -> list[np.ndarray]:
    """Channels of colour and texture; without ``full`` luminance and opponents over 8 mm, and the three bands of
    luminance."""
    linear = (rgb.astype(np.float64) / 255.0) ** 2.2
    red, green, blue = np.moveaxis(np.log(linear + _DARKEST), 2, 0)
    # Logarithms turn shading into an offset, which cancels in the opponent colours.
    opponents = [(red + green + blue) / 3.0, red - green, 0.5 * (red + green) - blue]
    blurs = [_Blur(mask, scale / pixel_size) for scale in SCALES]
    if full:
        levels = [[channel, *(blur(channel) for blur in blurs)] for channel in opponents]
        out = [level for channel in levels for level in channel[1:]]
    else:
        levels = [[opponents[0], *(blur(opponents[0]) for blur in blurs)]]
        out = [levels[0][2], *(blurs[1](channel) for channel in opponents[1:])]
    for channel in levels:
        for fine, coarse, blur in zip(channel[:-1], channel[1:], blurs):
            # Energy of a band, gathered over twice its scale.
            wide = _Blur(mask, 2.0 * blur.sigma)
            out.append(0.5 * np.log(wide((fine - coarse) ** 2) + 1e-5))
    for scale in SCALES[:2] if full else ():
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
    pixels = np.stack([columns, rows, np.ones_like(rows)]).reshape(3, -1).astype(np.float64)
    ray = np.linalg.solve(view.intrinsics, pixels)
    depth = view.depth.astype(np.float64)
    # Half a scale wide: less would show the quantisation of the depth, more would round edges off.
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
    out = [height, world[2], toward]
    for scale in _CURVATURE_SCALES:
        # Laplacian of the depth along the view, over the scale: positive on a bump [1/m].
        fine, coarse = _Blur(mask, 0.7 * scale / pixel_size)(depth), _Blur(mask, 1.4 * scale / pixel_size)(depth)
        curvature = (coarse - fine) / scale**2
        out.append(np.sign(curvature) * np.log1p(np.abs(curvature) / 10.0))
    inside = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] * pixel_size
    out.append(np.log1p(inside / SCALES[0]))
    return out
