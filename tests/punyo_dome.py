"""The dome of a real Punyo, and how far that of a model is from it."""

import numpy as np

from vsfsim.physics.bubble.sensor import BubbleModel

# h = HEIGHT (1 - rho^2)^POWER [m] with the elliptical radius rho, fitted to 150 frames of a sensor (rms 0.5 mm)
HEIGHT, POWER = 30.89e-3, 0.763


def stretches(model: BubbleModel) -> np.ndarray:
    """Principal stretches of every triangle of the free dome relative to the unstretched rubber (f, 2) [-], the larger
    first."""
    block = model.blocks[0]
    x = model.mesh.points[block.nodes]
    return np.linalg.svd(np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) @ block.parameters["inverse"], compute_uv=False)


def punyo_rms(model: BubbleModel) -> float:
    """Root mean square difference of the dome's height from the measured one [m], averaged over the rim's plane."""
    corners = model.mesh.points[model.mesh.faces]
    area = 0.5 * np.abs(np.cross(corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]))
    # the edge midpoints integrate squares of linear functions exactly
    x, y, z = np.moveaxis(0.5 * (corners + np.roll(corners, -1, axis=1)), 2, 0)
    a, b = model.spec.semi_axes
    measured = HEIGHT * np.clip(1.0 - (x / a) ** 2 - (y / b) ** 2, 0.0, None) ** POWER
    return float(np.sqrt(area @ ((z - measured) ** 2).mean(axis=1) / area.sum()))
