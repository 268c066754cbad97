"""What a feature extractor is, and how its image of features reaches the particles (SBML appendix B.2).

An extractor turns a view into a dense image of features, which is projected onto the particles: a visible particle
reads it by bilinear interpolation at its pixel, an occluded one takes the mean of its 10 nearest visible particles. An
extractor may add columns that follow from the geometry alone (how deep behind the surface a particle lies). `registry`
lists the extractors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import VsfError
from vsfsim.data.records import View
from vsfsim.vsf.particles import behind_surface

NEIGHBOURS = 10
"""Visible particles whose mean an occluded one takes (SBML appendix B.2)."""


@dataclass(frozen=True)
class FeatureImage:
    """Dense features of a view."""

    values: np.ndarray
    """(h, w, C) float32; cell (i, j) is centred on pixel (stride i + offset, stride j + offset)."""
    valid: np.ndarray
    """Cells that hold a feature of the object (h, w) bool; no other cell reaches a particle."""
    token: np.ndarray
    """The whole view in one vector (c,) float32, for methods without particles (SBML section 4.2)."""
    stride: float = 1.0
    """Distance between cells [px]."""
    offset: float = 0.0
    """Centre of the first cell [px]."""


@dataclass(frozen=True)
class Projection:
    """Particles in the camera's image."""

    points: np.ndarray
    """World positions (n, 3) [m]."""
    pixel: np.ndarray
    """(column, row) (n, 2) [px]."""
    behind: np.ndarray
    """Distance behind the visible surface along the optical axis, inf outside the mask (n,) [m]."""
    visible: np.ndarray
    """Whether the particle is at the visible surface (n,) bool."""
    spacing: float
    """Distance between neighbouring particles [m]."""


class Extractor(Protocol):
    """Features of a view."""

    def image(self, view: View) -> FeatureImage:
        """Dense features of the view."""

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Further columns, from the geometry alone (n, c)."""


def projection(view: View, particles: np.ndarray, spacing: float) -> Projection:
    """``particles`` (n, 3) [m] in the camera's image.

    Raises:
        VsfError: no particle is behind the view's mask.
    """
    pixel, behind = behind_surface(view, particles)
    hit = np.isfinite(behind)
    visible = hit & (np.abs(behind) <= spacing)
    if not visible.any():
        # The grid is so coarse, or the mask so thin, that no particle is near the surface: take the least deep ones.
        if not hit.any():
            raise VsfError(f"vsf.features: none of the {len(particles)} particles lies on a ray through the view's "
                           f"mask, so that none has a feature; are they of this view?")
        nearest = np.abs(behind)
        visible = nearest <= nearest.min()
    return Projection(particles, pixel, behind, visible, spacing)


def project(image: FeatureImage, projected: Projection) -> np.ndarray:
    """Image features on the particles (n, C): bilinear where visible, else the mean of the nearest visible ones."""
    out = np.empty((len(projected.points), image.values.shape[2]), np.float32)
    at = np.flatnonzero(projected.visible)
    visible = _bilinear(image, projected.pixel[at])
    out[at] = visible
    hidden = np.flatnonzero(~projected.visible)
    if len(hidden):
        count = min(NEIGHBOURS, len(at))
        near = cKDTree(projected.points[at]).query(projected.points[hidden], k=range(1, count + 1))[1]
        out[hidden] = visible[near].mean(axis=1)
    return out


def _bilinear(image: FeatureImage, pixel: np.ndarray) -> np.ndarray:
    """Features (k, C) at (column, row) pixels (k, 2).

    Invalid cells have no weight; a pixel between invalid cells only takes the nearest valid one.
    """
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
    """Zero mean and unit variance over the training particles (SBML appendix B.2)."""

    mean: np.ndarray
    """(F,) float32."""
    std: np.ndarray
    """(F,) float32; 1 for a constant column, so that it becomes 0."""

    @classmethod
    def of(cls, features: list[np.ndarray]) -> Normaliser:
        """From the features (n_k, F) of the training objects, with equal weight for every object."""
        mean = np.mean([f.mean(axis=0, dtype=np.float64) for f in features], axis=0)
        var = np.mean([((f.astype(np.float64) - mean) ** 2).mean(axis=0) for f in features], axis=0)
        std = np.sqrt(var)
        varies = std > 1e-6 * np.maximum(np.abs(mean), 1.0)
        return cls(mean.astype(np.float32), np.where(varies, std, 1.0).astype(np.float32))

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Normalised features, clipped at 6 standard deviations: a network would extrapolate beyond."""
        return np.clip((features - self.mean) / self.std, -6.0, 6.0)


def normalised_position(view: View, points: np.ndarray) -> np.ndarray:
    """Position (k, 3) within the box around the visible cloud, -1..1 along each axis; the table is z = 0."""
    cloud = view.points()
    low, high = cloud.min(axis=0), cloud.max(axis=0)
    low[2] = min(low[2], 0.0)
    return (points - 0.5 * (low + high)) / np.maximum(0.5 * (high - low), 1e-6)


class XyzRgb:
    """Normalised position and colour: the papers' naive feature (SBML appendix C.6)."""

    def image(self, view: View) -> FeatureImage:
        """Colour (H, W, 3) in 0..1."""
        values = view.rgb.astype(np.float32) / 255.0
        visible = values[view.mask]
        return FeatureImage(values, view.mask, np.concatenate([visible.mean(axis=0), visible.std(axis=0)]))

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Position within the box around the visible cloud, -1..1 along each axis (n, 3)."""
        return normalised_position(view, projected.points)
