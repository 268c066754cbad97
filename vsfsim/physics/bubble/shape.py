"""The shape of a free dome: stretches of the membrane, and the difference of its height map from a real Punyo's."""

from __future__ import annotations

import numpy as np

from vsfsim.physics.bubble.sensor import BubbleModel

# Height of a real sensor, h = HEIGHT (1 - rho^2)^POWER [m] with the elliptical radius rho, fitted to 150 of its frames
# (rms residual 0.5 mm).
HEIGHT, POWER = 30.89e-3, 0.763


def stretches(model: BubbleModel) -> np.ndarray:
    """Principal stretches of every triangle of the free dome relative to the unstretched rubber (f, 2) [-], the larger
    first."""
    block = model.blocks[0]
    x = model.mesh.points[block.nodes]
    deformation = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) @ block.parameters["inverse"]
    return np.linalg.svd(deformation, compute_uv=False)


def punyo_rms(model: BubbleModel) -> float:
    """Root mean square difference of the dome's height from the measured map [m], averaged over the rim's plane."""
    a, b = model.spec.semi_axes
    corners = model.mesh.points[model.mesh.faces]
    edge, other = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    area = 0.5 * np.abs(edge[:, 0] * other[:, 1] - edge[:, 1] * other[:, 0])
    total = 0.0
    # the edge midpoints integrate squares of linear functions exactly
    for k in range(3):
        x, y, z = (0.5 * (corners[:, k] + corners[:, (k + 1) % 3])).T
        measured = HEIGHT * np.clip(1.0 - (x / a) ** 2 - (y / b) ** 2, 0.0, None) ** POWER
        total += float((area * (z - measured) ** 2).sum()) / 3.0
    return float(np.sqrt(total / area.sum()))
