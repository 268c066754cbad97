"""Triangles of rigid shapes, to draw them."""

from __future__ import annotations

import numpy as np

from vsfsim.core.shape import Box, Plane, ProbeShape
from vsfsim.physics.contact.body_samples import surface


def tessellate(shape: ProbeShape, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) [m] and triangles (g, 3) of a rigid shape in its own frame; a plane is a square plate of edge
    ``size`` [m]."""
    if isinstance(shape, Plane):
        vertices, faces = surface(Box((size, size, 0.02 * size)))
        return vertices - [0.0, 0.0, 0.01 * size], faces
    return surface(shape)
