"""The default features: what a view shows of a surface at several metric scales, without anything to download.

`local` is for the tens of training objects that there usually are. It has 11 numbers: log luminance and two opponent
colours, blurred over 8 mm; the energy of the luminance in three bands, up to 3, 8 and 20 mm (texture); and for every
particle its position in the visible box, its depth behind the surface and its distance to the nearest visible point.
Scales are in metres, so that the distance of the camera does not matter. All blurs are normalised by the blurred mask,
so that the background has no influence.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Projection, normalised_position

SCALES = (0.003, 0.008, 0.020)
"""Standard deviations of the blurs [m]."""
# Darker than this is black to an 8-bit camera; it keeps the logarithm finite.
_DARKEST = 0.01
# Depths behind the surface are clipped here: deeper particles do not differ for touch [m].
_DEEPEST = 0.05


class LocalDescriptor:
    """The module's features."""

    def image(self, view: View) -> FeatureImage:
        """Dense features, one cell a pixel (H, W, 6)."""
        mask = np.asarray(view.mask, bool)
        pixel_size = float(np.median(view.depth[mask])) / float(view.intrinsics[0, 0])
        values, part = np.zeros((*mask.shape, 6), np.float32), _around(mask, int(4.0 * SCALES[-1] / pixel_size) + 2)
        values[part] = np.stack(_colour(view.rgb[part], mask[part], pixel_size), axis=-1)
        visible = values[mask].astype(np.float64)
        token = np.concatenate([visible.mean(axis=0), visible.std(axis=0)])
        return FeatureImage(values, mask, token.astype(np.float32))

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Position, and logarithms of the depth behind the surface and of the distance to the nearest visible point
        (n, 5)."""
        place = normalised_position(view, projected.points)
        return np.concatenate([place, depth_and_distance(view, projected)], axis=1)


def depth_and_distance(view: View, projected: Projection) -> np.ndarray:
    """Logarithms of the particles' depth behind the surface and of their distance to the nearest visible point, over
    their spacing (n, 2) [-]."""
    # nodes that are cells, not boxes around points, are searched three times faster from deep inside an object
    away = cKDTree(view.points(), compact_nodes=False).query(projected.points)[0]
    behind = np.clip(projected.behind, 0.0, _DEEPEST)
    return np.log1p(np.stack([behind, away], axis=1) / projected.spacing)


def _around(mask: np.ndarray, apart: int) -> tuple[slice, ...]:
    """The part of an image within ``apart`` pixels of the mask, in rows and in columns.

    A blur ends at four sigma and mirrors the image at its borders. With two sigma and a pixel around it, the mask is
    blurred as in the whole image, because no pixel of it sees another one in the mirror of a border that is new.
    """
    return tuple(slice(max(int(at.min()) - apart, 0), int(at.max()) + apart + 1)
                 for at in np.nonzero(mask))


class _Blur:
    """Gaussian blur over the mask only; ``sigma`` in pixels."""

    def __init__(self, mask: np.ndarray, sigma: float):
        self.mask, self.sigma = mask.astype(np.float64), max(sigma, 0.3)
        self.weight = np.maximum(ndimage.gaussian_filter(self.mask, self.sigma), 1e-6)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(np.where(self.mask > 0.0, values, 0.0), self.sigma) / self.weight


def _colour(rgb: np.ndarray, mask: np.ndarray, pixel_size: float) -> list[np.ndarray]:
    """Luminance and opponent colours over 8 mm, and the three bands of luminance."""
    linear = (rgb.astype(np.float64) / 255.0) ** 2.2
    red, green, blue = np.moveaxis(np.log(linear + _DARKEST), 2, 0)
    blurs = [_Blur(mask, scale / pixel_size) for scale in SCALES]
    luminance = (red + green + blue) / 3.0
    levels = [luminance, *(blur(luminance) for blur in blurs)]
    # Logarithms turn shading into an offset, which cancels in the opponent colours.
    out = [levels[2], blurs[1](red - green), blurs[1](0.5 * (red + green) - blue)]
    for fine, coarse, blur in zip(levels[:-1], levels[1:], blurs):
        # Energy of a band, gathered over twice its scale.
        out.append(0.5 * np.log(_Blur(mask, 2.0 * blur.sigma)((fine - coarse) ** 2) + 1e-5))
    return out
