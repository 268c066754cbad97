"""The two surfaces of a pair in a step: their positions, and which faces a node may meet.

The unknowns are the displacements of the object's nodes in the world and, after them, those of the sensor's nodes in
the sensor's own frame: there its elements and its rest-state factor stay the same while it is carried along.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.pair import kernels
from vsfsim.physics.contact.pair.sides import make_sides, reachable
from vsfsim.physics.model import Model

_MARGIN = 0.3  # of a stride: the surfaces may approach each other by so much in a step by their own motion


class PairSurfaces:
    """Positions and candidates of B touches of an object by a sensor's surface. The nodes of a touch are those of the
    object in reach, padded, and after them the m of the sensor: S in all.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame; its displacements are 0 in the free state.
        friction: Coulomb's coefficient [-].
        poses: all poses to come, sensor to world (T, B, 4, 4): they tell what is in reach.
        device: Warp device.
        stride: longest way of the sensor in a step [m].
    """

    dof: torch.Tensor
    """Degrees of freedom of the nodes (B, 3 S); -1 is padding."""
    mask: torch.Tensor
    """1 where `dof` is no padding (B, 3 S) [-]."""
    free: torch.Tensor
    """1 where a degree of freedom may move (B, 3 S) [-]."""
    turn: torch.Tensor
    """Rotations of the sensor at present (B, 3, 3) [-]."""
    origin: torch.Tensor
    """Its origins (B, 1, 3) [m], world."""

    def __init__(self, model: Model, sensor: Model, friction: float, poses: np.ndarray, *, device: str, stride: float):
        mesh, own = model.mesh, sensor.mesh
        self.device, self.margin = device, _MARGIN * stride
        self.batch, self.count = poses.shape[1], len(mesh.points)
        self.reach = farthest(sensor)
        self.kernels = kernels.kernels()
        reach = reachable(model, sensor, poses)
        nodes = [np.unique(mesh.faces[f]) for f in reach]
        batch, m, width = self.batch, len(own.points), max(1, max(len(n) for n in nodes))
        self.width = width
        listed = np.full((batch, width), -1, np.int64)
        rest = np.zeros((batch, width, 3))
        for b, n in enumerate(nodes):
            listed[b, :len(n)], rest[b, :len(n)] = n, mesh.points[n]

        def many(values: np.ndarray) -> np.ndarray:
            return np.broadcast_to(values, (batch, *values.shape))

        carried = 3 * (self.count + np.arange(m))[:, None] + np.arange(3)
        objects = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1)
        self.dof = torch.as_tensor(np.concatenate([objects, many(carried)], axis=1).reshape(batch, -1), device=device)
        self.mask = (self.dof >= 0).to(torch.float64)
        free = torch.as_tensor(np.concatenate([model.free, sensor.free]), dtype=torch.float64, device=device)
        self.free = free[self.dof.clamp(min=0)] * self.mask
        self._rest = torch.as_tensor(np.concatenate([rest, many(own.points)], axis=1), device=device)
        # positions now, when the step began, and where the surfaces would be if both had kept their shapes
        self.x, self.x_before, self.x_swept = (self._rest.clone() for _ in range(3))
        self.sides = make_sides(model, sensor, reach, nodes, width, {
            "coefficient": float(friction), "x": self.x, "x_before": self.x_before, "x_swept": self.x_swept},
            device=device)
        self._moved_to: tuple[np.ndarray, torch.Tensor] | None = None

    def _place(self, pose: np.ndarray) -> None:
        """Put the sensor at ``pose`` (B, 4, 4)."""
        at = torch.as_tensor(pose, dtype=torch.float64, device=self.device)
        self.turn, self.origin = at[:, :3, :3], at[:, None, :3, 3]

    def _world(self, columns: torch.Tensor | slice, moved: torch.Tensor) -> torch.Tensor:
        """World positions (k, S, 3) [m] of the nodes of ``columns`` at displacements (k, 3 S) [m]."""
        out = self._rest[columns] + moved.view(len(moved), -1, 3)
        out[:, self.width:] = out[:, self.width:] @ self.turn[columns].mT + self.origin[columns]
        return out

    def carried(self, vectors: torch.Tensor, *, place: bool) -> torch.Tensor:
        """Vectors (m, 3, B) of the sensor's frame in the world, or points of it if ``place``, at the present pose."""
        out = torch.einsum("bij,mjb->mib", self.turn, vectors)
        return out + self.origin[:, 0].T if place else out

    def begin_step(self, before: np.ndarray, moved: torch.Tensor) -> None:
        """Begin a step with the sensor at ``before`` (B, 1, 4, 4) and displacements (B, 3 S) [m] of the nodes."""
        self._moved, self._pose_before = moved, before[:, 0]
        self._place(self._pose_before)
        self.x_before.copy_(self._world(slice(None), moved))

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> bool:
        """Move the sensor to ``pose`` (B, 1, 4, 4) and find what the touches ``columns`` (k,) may meet on the way; of
        the others nothing moves. Returns whether anything was new."""
        pose = pose[:, 0]
        self._place(pose)
        known = self._moved_to
        if known is not None and np.array_equal(known[0], pose) and torch.equal(known[1], self._moved):
            return False
        self._moved_to = (pose.copy(), self._moved)
        self.x_swept.copy_(self._world(slice(None), self._moved))
        self.x[columns] = self.x_swept[columns]
        change = pose - self._pose_before
        way = np.linalg.norm(change[:, :3, 3], axis=1) + self.reach * np.linalg.norm(change[:, :3, :3], axis=(1, 2))
        self.find_candidates(float(way.max()) + self.margin, columns, blend=columns)
        return True

    def displace(self, columns: torch.Tensor, moved: torch.Tensor) -> None:
        """Set the positions of the nodes of ``columns`` (k,) to displacements (k, 3 S) [m], the sensor's in its
        frame."""
        self.x[columns] = self._world(columns, moved)

    def find_candidates(self, within: float, columns: torch.Tensor, *, blend: torch.Tensor) -> None:
        """Find the faces no further than ``within`` [m] from each node of ``columns`` (k,) at the present positions.
        The touches ``blend`` (j,) also get new normals."""
        some = wp.from_torch(columns.to(torch.int32))
        for side in self.sides:
            wp.launch(self.kernels.search, dim=(side.tensors["stiffness"].shape[1], len(columns)), device=self.device,
                      inputs=[side.points, some, within])
            if len(blend):
                side.tensors["smooth"][blend] = side.blended(self.x)[blend]


def farthest(sensor: Model) -> float:
    """How far the sensor's surface reaches from the origin of its frame [m]."""
    return float(np.linalg.norm(sensor.mesh.points, axis=1).max())
