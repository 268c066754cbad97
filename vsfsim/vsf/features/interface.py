"""Visual features of the particles behind a view (SBML appendix B.2), behind one interface.

An extractor turns a view into a dense image of features. The image is projected onto the particles: a visible particle
reads it by bilinear interpolation at its pixel, an occluded one takes the mean of its 10 nearest visible particles. An
extractor may add columns that only geometry can tell (how deep behind the surface a particle lies).

    xyzrgb      normalised position and colour (SBML appendix C.6), 6 numbers
    local       the default: colour, texture and place relative to the seen surface, see `descriptor`, 11 numbers
    local-full  the same at more scales, with normals, curvature and the distance to the outline, 32 numbers
    dinov2-s    DINOv2 ViT-S/14 patch features (SBML's default), 384 numbers; needs weights, see `dinov2`
    dinov2-b    DINOv2 ViT-B/14, 768 numbers
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import VsfError, did_you_mean
from vsfsim.data.records import View

NEIGHBOURS = 10
"""Visible particles whose mean an occluded one takes (SBML appendix B.2)."""


@dataclass(frozen=True)
class FeatureImage:
    """Dense features of a view.

    values: (h, w, C) float32; cell (i, j) is centred on pixel (stride i + offset, stride j + offset).
    valid: cells that hold a feature of the object (h, w) bool; the others never reach a particle.
    stride, offset: of the cells [px].
    token: the whole view in one vector (c,) float32, for methods without particles (SBML section 4.2).
    """

    values: np.ndarray
    valid: np.ndarray
    token: np.ndarray
    stride: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Geometry:
    """Particles as the camera sees them.

    points: world (n, 3) [m]. pixel: (column, row) (n, 2) [px]. behind: how far behind the seen surface along the
    optical axis, inf where the camera sees no object (n,) [m]. visible: at the surface (n,) bool. spacing: of the
    particles [m].
    """

    points: np.ndarray
    pixel: np.ndarray
    behind: np.ndarray
    visible: np.ndarray
    spacing: float


def particle_features(name: str, view: View, particles: np.ndarray, *, spacing: float, weights: str = "",
                      device: str = "cpu") -> np.ndarray:
    """Features of the particles (n, F) float32, not normalised.

    Args:
        name: one of `NAMES`.
        view: the image. particles: rest positions, world (n, 3) [m]. spacing: their distance [m]; a particle is visible
        within
            one spacing of the seen surface.
        weights: file of pretrained weights, for the DINOv2 extractors; "" looks in the usual caches.
        device: torch device of the DINOv2 extractors.

    Raises:
        VsfError: unknown name, no particle, an empty mask, particles of which the camera sees none, or weights that are
        missing or do not fit.
    """
    extractor = _extractor(name, weights, device)
    particles = np.asarray(particles, np.float64)
    if particles.ndim != 2 or particles.shape[1:] != (3,) or len(particles) == 0:
        raise VsfError(f"vsf.features: particles have shape {particles.shape}; give at least one world position (n, "
                       f"3) in metres.")
    if not view.mask.any():
        raise VsfError("vsf.features: the view's mask is empty; point the camera at the object.")
    geometry = see(view, particles, spacing)
    image = extractor.image(view)
    projected = project(image, geometry)
    extra = extractor.of_particles(view, geometry)
    return np.concatenate([projected, extra], axis=1).astype(np.float32)


def view_token(name: str, view: View, *, weights: str = "", device: str = "cpu") -> np.ndarray:
    """One vector for the whole view (c,) float32: DINOv2's class token, or the mean and spread of a dense descriptor.

    Raises:
        VsfError: as `particle_features`.
    """
    if not view.mask.any():
        raise VsfError("vsf.features: the view's mask is empty; point the camera at the object.")
    return _extractor(name, weights, device).image(view).token.astype(np.float32)


def see(view: View, particles: np.ndarray, spacing: float) -> Geometry:
    """Where the camera sees each of ``particles`` (n, 3) [m]."""
    world_to_camera = np.linalg.inv(np.asarray(view.camera_pose, np.float64))
    local = particles @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = (local / local[:, 2:]) @ view.intrinsics.T[:, :2]
    pixel = np.where(local[:, 2:] > 0.0, pixel, -1e9)
    column, row = np.rint(pixel).astype(np.int64).T
    height, width = view.mask.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    hit = inside & view.mask[row, column]
    behind = np.where(hit, local[:, 2] - view.depth[row, column], np.inf)
    visible = hit & (np.abs(behind) <= spacing)
    if not visible.any():
        # A grid so coarse, or a mask so thin, that no particle is near the surface: the least deep ones stand for it.
        if not hit.any():
            raise VsfError(f"vsf.features: none of the {len(particles)} particles lies on a ray through the view's "
                           f"mask, so that none has a feature; are they of this view?")
        nearest = np.abs(behind)
        visible = nearest <= nearest.min()
    return Geometry(particles, pixel, behind, visible, spacing)


def project(image: FeatureImage, geometry: Geometry) -> np.ndarray:
    """Image features on the particles (n, C): bilinear where visible, else the mean of the nearest visible ones."""
    out = np.empty((len(geometry.points), image.values.shape[2]), np.float32)
    at = np.flatnonzero(geometry.visible)
    seen = _bilinear(image, geometry.pixel[at])
    out[at] = seen
    hidden = np.flatnonzero(~geometry.visible)
    if len(hidden):
        count = min(NEIGHBOURS, len(at))
        near = cKDTree(geometry.points[at]).query(geometry.points[hidden], k=range(1, count + 1))[1]
        out[hidden] = seen[near].mean(axis=1)
    return out


def _bilinear(image: FeatureImage, pixel: np.ndarray) -> np.ndarray:
    """(k, C) at (column, row) pixels (k, 2); cells without the object have no weight, and a pixel among none of them
    takes the nearest cell."""
    height, width = image.valid.shape
    x = np.clip((pixel[:, 0] - image.offset) / image.stride, 0.0, width - 1.0)
    y = np.clip((pixel[:, 1] - image.offset) / image.stride, 0.0, height - 1.0)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = x - left, y - top
    total, weight = np.zeros((len(pixel), image.values.shape[2])), np.zeros(len(pixel))
    for row, column, w in ((top, left, (1 - fy) * (1 - fx)), (top, right, (1 - fy) * fx), (bottom, left, fy * (1 - fx)),
                           (bottom, right, fy * fx)):
        w = w * image.valid[row, column]
        total += w[:, None] * image.values[row, column]
        weight += w
    lost = np.flatnonzero(weight < 1e-6)
    out = total / np.maximum(weight, 1e-6)[:, None]
    if len(lost):
        cells = np.argwhere(image.valid)
        near = cells[cKDTree(cells).query(np.stack([y, x], axis=1)[lost])[1]]
        out[lost] = image.values[near[:, 0], near[:, 1]]
    return out


@dataclass(frozen=True)
class Normaliser:
    """Zero mean and unit variance over the training particles (SBML appendix B.2).

    mean, std: (F,) float32; a column that never varied has std 1, so that it stays 0.
    """

    mean: np.ndarray
    std: np.ndarray

    @classmethod
    def of(cls, features: list[np.ndarray]) -> Normaliser:
        """From the features (n_k, F) of the training objects, every object weighing the same."""
        mean = np.mean([f.mean(axis=0, dtype=np.float64) for f in features], axis=0)
        var = np.mean([((f.astype(np.float64) - mean) ** 2).mean(axis=0) for f in features], axis=0)
        std = np.sqrt(var)
        return cls(mean.astype(np.float32), np.where(std > 1e-6 * np.maximum(np.abs(mean), 1.0), std,
                                                     1.0).astype(np.float32))

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Normalised features, cut at 6 standard deviations: beyond, a network would extrapolate."""
        return np.clip((features - self.mean) / self.std, -6.0, 6.0)


class XyzRgb:
    """Normalised position and colour, the papers' naive feature."""

    def image(self, view: View) -> FeatureImage:
        """Colour in 0..1."""
        values = view.rgb.astype(np.float32) / 255.0
        seen = values[view.mask]
        return FeatureImage(values, view.mask, np.concatenate([seen.mean(axis=0), seen.std(axis=0)]))

    def of_particles(self, view: View, geometry: Geometry) -> np.ndarray:
        """Position within the box around the visible cloud, -1..1 along each axis (n, 3)."""
        return normalised_position(view, geometry.points)


def normalised_position(view: View, points: np.ndarray) -> np.ndarray:
    """Position (k, 3) within the box around the visible cloud, -1..1 along each axis; the table is z = 0."""
    cloud = view.points()
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    low[2] = min(low[2], 0.0)
    return (points - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-6)


def _extractor(name: str, weights: str, device: str) -> Any:
    if name not in NAMES:
        raise VsfError(f"vsf.features: there are no features called '{name}'. {did_you_mean(name, NAMES)}")
    return NAMES[name](weights, device)


def _local(full: bool) -> Callable[[str, str], Any]:
    def make(_weights: str, _device: str) -> Any:
        from vsfsim.vsf.features.descriptor import LocalDescriptor

        return LocalDescriptor(full=full)

    return make


def _dinov2(size: str) -> Callable[[str, str], Any]:
    def make(weights: str, device: str) -> Any:
        from vsfsim.vsf.features.dinov2 import Dinov2

        return Dinov2.load(size, weights, device=device)

    return make


NAMES: Mapping[str, Callable[[str, str], XyzRgb]] = {
    "local": _local(False),
    "local-full": _local(True),
    "xyzrgb": lambda _weights, _device: XyzRgb(),
    "dinov2-s": _dinov2("small"),
    "dinov2-b": _dinov2("base"),
}
"""Extractors by name: (weights, device) -> extractor with `image` and `of_particles`."""
