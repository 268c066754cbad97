"""The feature extractors by name, and the features of the particles behind a view (SBML appendix B.2).

    xyzrgb      normalised position and colour (SBML appendix C.6), 6 numbers
    local       the default: colour, texture and position relative to the visible surface, see `descriptor`, 11 numbers
    place       thickness of the visible part, its place relative to the foot and how deep a particle lies, as
                logarithms, for branching objects, see `thickness`, 6 numbers
    dinov2-s    DINOv2 ViT-S/14 patch features (SBML's default), 384 numbers; needs weights, see `dinov2`
    dinov2-b    DINOv2 ViT-B/14, 768 numbers
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from vsfsim.core.errors import VsfError, one_of
from vsfsim.data.records import View
from vsfsim.vsf.features.descriptor import LocalDescriptor
from vsfsim.vsf.features.interface import Extractor, XyzRgb, project, projection
from vsfsim.vsf.features.thickness import PlaceDescriptor


def particle_features(name: str, view: View, particles: np.ndarray, *, spacing: float, weights: str = "",
                      device: str = "cpu") -> np.ndarray:
    """Features of the particles (n, F) float32, not normalised.

    Args:
        name: one of `NAMES`.
        view: the image.
        particles: rest positions, world (n, 3) [m].
        spacing: distance between neighbouring particles [m]; a particle within it of the visible surface is visible.
        weights: file of pretrained weights, for the DINOv2 extractors; "" searches the usual caches.
        device: torch device of the DINOv2 extractors.

    Raises:
        VsfError: an unknown name, no particle, an empty mask, no particle behind the mask, or weights that are missing
            or do not fit.
    """
    extractor = _extractor(name, weights, device)
    particles = np.asarray(particles, np.float64)
    if particles.ndim != 2 or particles.shape[1:] != (3,) or len(particles) == 0:
        raise VsfError(f"vsf.features: particles have shape {particles.shape}; give at least one world position (n, "
                       f"3) in metres.")
    _check_mask(view)
    projected = projection(view, particles, spacing)
    columns = project(extractor.image(view), projected), extractor.of_particles(view, projected)
    return np.concatenate(columns, axis=1).astype(np.float32)


def view_token(name: str, view: View, *, weights: str = "", device: str = "cpu") -> np.ndarray:
    """One vector for the whole view (c,) float32: DINOv2's class token, or the mean and spread of a dense descriptor.

    Raises:
        VsfError: as `particle_features`.
    """
    _check_mask(view)
    return _extractor(name, weights, device).image(view).token.astype(np.float32)


def _check_mask(view: View) -> None:
    if not view.mask.any():
        raise VsfError("vsf.features: the view's mask is empty; point the camera at the object.")


def _extractor(name: str, weights: str, device: str) -> Extractor:
    return NAMES[one_of(name, NAMES, "vsf.features: the name", VsfError)](weights, device)


def _dinov2(size: str) -> Callable[[str, str], Extractor]:
    def make(weights: str, device: str) -> Extractor:
        from vsfsim.vsf.features.dinov2 import Dinov2  # imports torch

        return Dinov2.load(size, weights, device=device)

    return make


NAMES: Mapping[str, Callable[[str, str], Extractor]] = {
    "local": lambda _weights, _device: LocalDescriptor(),
    "place": lambda _weights, _device: PlaceDescriptor(),
    "xyzrgb": lambda _weights, _device: XyzRgb(),
    "dinov2-s": _dinov2("small"),
    "dinov2-b": _dinov2("base"),
}
"""Extractors by name: (weights, device) -> extractor."""
