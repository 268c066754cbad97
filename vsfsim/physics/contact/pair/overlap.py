"""How deep the two surfaces of a pair lie in one another, between their contact points too: a check by geometry.

Points on a grid over every face of either surface are held against the other body, see `intrusion.Enclosure`. A
membrane is closed by the disk in its rim.
"""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.contact.intrusion import Enclosure, rim_disk
from vsfsim.physics.contact.patch import shape_values
from vsfsim.physics.elements import closest_point
from vsfsim.physics.model import Model

_DEEP = 0.1  # that depth over the smaller of both element sizes
_SPACING = 0.4  # of the points on a face over the smaller of both element sizes
_STEPS = (3, 16)  # least and most steps of the grid on a face


class PairOverlap:
    """The check for an object and a sensor.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame.
        device: Warp device.
    """

    tolerance: float
    """Depth above which one body lies inside the other where no contact point feels it [m]."""

    def __init__(self, model: Model, sensor: Model, *, device: str):
        self._count = len(model.mesh.points)
        self._rest = torch.as_tensor(np.concatenate([model.mesh.points, sensor.mesh.points]), device=device)
        sizes = model.element_size, sensor.element_size
        self.tolerance = _DEEP * min(sizes)
        carried = sensor.mesh.faces + self._count
        self._surfaces = (Enclosure(model.mesh.faces, np.zeros((0, 3)), device=device),
                          Enclosure(carried, rim_disk(carried), device=device))
        self._grids = [torch.as_tensor(_grid(size / min(sizes), surface.faces.shape[2]), device=device)
                       for size, surface in zip(sizes, self._surfaces, strict=True)]

    def check(self, columns: torch.Tensor, turn: torch.Tensor, origin: torch.Tensor,
              u: torch.Tensor) -> torch.Tensor:
        """How deep the surfaces lie in one another.

        Args:
            columns: touches (k,).
            turn, origin: rotations (k, 3, 3) [-] and origins (k, 1, 3) [m] of the sensor in the world.
            u: displacements (3 n, B) [m], the object's in the world, then the sensor's in its frame.

        Returns:
            Depth of the deepest point of either surface inside the other body (k,) [m].
        """
        count = len(columns)
        x = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        x[:, self._count:] = x[:, self._count:] @ turn.mT + origin
        balls = [closest_point.balls(x, surface.faces) for surface in self._surfaces]
        touch, out = torch.arange(count, device=x.device)[:, None, None], x.new_zeros(count)
        for own, other, grid, ball, around in zip(self._surfaces, self._surfaces[::-1], self._grids, balls,
                                                  balls[::-1], strict=True):
            # faces that come near the box about the other surface, padded to the most of any touch
            low = (around[:, :, :3] - around[:, :, 3:]).amin(dim=1, keepdim=True)
            high = (around[:, :, :3] + around[:, :, 3:]).amax(dim=1, keepdim=True)
            near = ((ball[:, :, :3] + ball[:, :, 3:] > low) & (ball[:, :, :3] - ball[:, :, 3:] < high)).all(dim=2)
            if most := int(near.sum(dim=1).amax()):
                at = torch.sort(near.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :most]
                points = grid @ x[touch, own.faces[0].long()[at]]
                out = torch.maximum(out, other.depth(x, points.flatten(1, 2))[0].amax(dim=1))
        return out


def _grid(ratio: float, corners: int) -> np.ndarray:
    """Shape values (s, 3 or 6) of the points on a face whose size is ``ratio`` times the smaller element size [-]."""
    steps = int(np.clip(np.ceil(ratio / _SPACING), *_STEPS))
    bary = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    return shape_values(bary) if corners == 6 else bary
