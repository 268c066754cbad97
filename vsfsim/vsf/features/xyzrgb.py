"""Normalised position and colour: the papers' naive feature (SBML appendix C.6)."""

from __future__ import annotations

import numpy as np

from vsfsim.data.records import View
from vsfsim.vsf.features.interface import FeatureImage, Projection, normalised_position


class XyzRgb:
    """Colour from the image, position from the particle."""

    def image(self, view: View) -> FeatureImage:
        """Colour (H, W, 3) in 0..1."""
        values = view.rgb.astype(np.float32) / 255.0
        visible = values[view.mask]
        return FeatureImage(values, view.mask, np.concatenate([visible.mean(axis=0), visible.std(axis=0)]))

    def of_particles(self, view: View, projected: Projection) -> np.ndarray:
        """Position within the box around the visible cloud, -1..1 along each axis (n, 3)."""
        return normalised_position(view, projected.points)
