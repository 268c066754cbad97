"""The shape of a dented membrane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.physics.bubble.sensor import BubbleModel
from vsfsim.sensing.membrane_fe import area_vectors, nodal_normals


@dataclass(frozen=True)
class Dent:
    """Shape of the dented skin in one frame."""

    depth: float
    """Largest displacement of a node along the press [m]."""
    radius: float
    """Of the circle with the area, projected along the press, of the skin displaced by half of that or more [m]."""
    bulge: float
    """Largest displacement of a node outwards along the free dome's normal [m]."""


def dent(model: BubbleModel, position: np.ndarray, axis: np.ndarray) -> Dent:
    """The dent of one frame.

    Args:
        model: the bubble.
        position: of its nodes, mount frame (n, 3) [m].
        axis: unit direction of the bodies into the dome, mount frame (3,).
    """
    mesh = model.mesh
    along = (position - mesh.points) @ axis
    most = float(along.max())
    share = share_above(along[mesh.faces] - 0.5 * most)
    area = float((np.abs(area_vectors(mesh.points, mesh.faces) @ axis) * share).sum())
    return Dent(most, float(np.sqrt(area / np.pi)), float(-inward_distance(model, position).min()))


def inward_distance(model: BubbleModel, position: np.ndarray) -> np.ndarray:
    """How far every node (n,) [m] has moved inwards along the free dome's normal; negative where it bulges out."""
    mesh = model.mesh
    return -((position - mesh.points) * nodal_normals(mesh.points, mesh.faces)).sum(axis=1)


def share_above(values: np.ndarray) -> np.ndarray:
    """Share of a triangle's area where a linear function, given at its corners (f, 3), is positive (f,)."""
    low, middle, high = np.sort(values, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):
        one = high**2 / ((high - low) * (high - middle))  # only the highest corner is positive
        two = 1.0 - low**2 / ((middle - low) * (high - low))  # only the lowest corner is not
    return np.where(low >= 0.0, 1.0, np.where(high <= 0.0, 0.0, np.where(middle > 0.0, two, one)))
