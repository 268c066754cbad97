"""Where points of one picture lie in another: pyramidal tracking (Lucas and Kanade 1981; Bouguet 2001)."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

_LEVELS = 4  # each half as wide as the one before
_HALF = 12  # pixels from the middle of a patch to its edge, on every level
_ROUNDS = 15  # at most, on every level
_STILL = 0.01  # a step that is shorter ends the rounds [px]
_TEXTURE = 1e-2  # least eigenvalue of the structure tensor over the largest one of all patches


def track(before: np.ndarray, after: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Follow points from one picture to another.

    Args:
        before, after: grey pictures (H, W).
        points: in ``before`` (n, 2), column and row [px].

    Returns:
        Their places in ``after`` (n, 2), column and row [px]; and the similarity of the patches around them, their
        correlation (n,) in -1..1, or -1 where the patch has no texture or lies outside.
    """
    pyramid = [(np.asarray(before, float), np.asarray(after, float))]
    for _ in range(_LEVELS - 1):
        pyramid.append(tuple(gaussian_filter(image, 1.0)[::2, ::2] for image in pyramid[-1]))  # type: ignore[arg-type]
    offset = np.stack(np.meshgrid(*[np.arange(-_HALF, _HALF + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * (offset**2).sum(axis=1) / (0.5 * _HALF) ** 2)
    places = np.asarray(points, float)[:, ::-1]  # row, column
    moved = np.zeros_like(places)
    for level in reversed(range(_LEVELS)):
        one, other = (gaussian_filter(image, 0.7) for image in pyramid[level])
        at = places[:, None] / 2**level + offset
        patch, contrast = _plain(_sample(one, at), weight)
        slope = np.stack([_sample(g, at) for g in np.gradient(one)], axis=-1)  # (n, patch, 2)
        tensor = np.einsum("p,npi,npj->nij", weight, slope, slope)
        values = np.linalg.eigvalsh(tensor)
        rich = values[:, 0] > _TEXTURE * values[:, 1].max(initial=0.0) * 1e-2
        inverse = np.linalg.inv(tensor + 1e-9 * np.maximum(values[:, 1], 1e-12)[:, None, None] * np.eye(2))
        moved *= 2.0
        for _ in range(_ROUNDS):
            found, size = _plain(_sample(other, at + moved[:, None]), weight)
            # without mean and contrast, for the light in the sensor changes as the skin comes nearer
            lost = patch - found * (contrast / np.maximum(size, 1e-12))[:, None]
            step = np.einsum("nij,npj,np,p->ni", inverse, slope, lost, weight)
            step /= np.maximum(1.0, np.linalg.norm(step, axis=1, keepdims=True) / _HALF)
            moved += np.where(rich[:, None], step, 0.0)
            if np.abs(step[rich]).max(initial=0.0) < _STILL:
                break
    found, size = _plain(_sample(other, at + moved[:, None]), weight)
    both = np.where(rich, contrast * size, 0.0)
    likeness = np.where(both > 0.0, np.average(patch * found, axis=1, weights=weight) / np.maximum(both, 1e-300), -1.0)
    out = places + moved
    inside = ((out >= 0) & (out <= np.array(before.shape) - 1)).all(axis=1)
    return out[:, ::-1], np.where(inside, likeness, -1.0)


def _plain(patches: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patches (n, p) without their mean, and their contrast, the standard deviation (n,)."""
    out = patches - np.average(patches, axis=1, weights=weight)[:, None]
    return out, np.sqrt(np.average(out**2, axis=1, weights=weight))


def _sample(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """``image`` (H, W) between its pixels, at rows and columns (..., 2)."""
    return map_coordinates(image, np.moveaxis(at, -1, 0), order=1, mode="nearest")
