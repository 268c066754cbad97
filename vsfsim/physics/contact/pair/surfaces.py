"""The two surfaces of a pair in a step: their positions, which faces a node may meet, and the patch that these make.

The unknowns are the displacements of the object's nodes in the world and, after them, those of the sensor's nodes in
the sensor's own frame: there its elements and its rest-state factor stay the same while it is carried along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.pair import kernels
from vsfsim.physics.contact.pair.sides import make_sides, reachable
from vsfsim.physics.model import Model

_MARGIN = 0.3  # of a stride: the surfaces may approach each other by so much in a step by their own motion


@dataclass(frozen=True)
class PairPatch:
    """The nodes of both surfaces that may take part in a step, padded to s; the object's come first."""

    split: int
    """Number of the object's nodes, with padding."""
    nodes: torch.Tensor
    """Surface nodes of the touch (B, s)."""
    on: torch.Tensor
    """Whether a node is no padding (B, s) bool."""
    place: torch.Tensor
    """Where each surface node of a touch is in `nodes` (B, S)."""
    dof: torch.Tensor
    """Degrees of freedom (B, 3 s); -1 is padding."""
    mask: torch.Tensor
    """1 where `dof` is no padding (B, 3 s) [-]."""
    free: torch.Tensor
    """1 where a degree of freedom may move (B, 3 s) [-]."""
    rest: torch.Tensor
    """Rest positions (B, 3 s) [m], the sensor's in its frame."""
    on_object: torch.Tensor
    """Degrees of freedom among the object's surface nodes in reach (B, 3 split)."""
    on_sensor: torch.Tensor
    """Degrees of freedom among all nodes of the sensor (B, 3 (s - split))."""

    @property
    def index(self) -> torch.Tensor:
        """`dof` with 0 for padding (B, 3 s)."""
        return self.dof.clamp(min=0)


class PairSurfaces:
    """Positions, candidates and patch of B touches of an object by a sensor's surface.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame; its displacements are 0 in the free state.
        poses: all poses to come, sensor to world (T, B, 4, 4): they tell what is in reach.
        device: Warp device.
        stride: longest way of the sensor in a step [m].
    """

    patch: PairPatch
    """The patch of the present step."""
    pose: np.ndarray
    """Present sensor poses (B, 4, 4)."""
    turn: torch.Tensor
    """Their rotations (B, 3, 3) [-]."""

    def __init__(self, model: Model, sensor: Model, poses: np.ndarray, *, device: str, stride: float):
        mesh, own = model.mesh, sensor.mesh
        self.device, self.margin = device, _MARGIN * stride
        self.batch, self.count = poses.shape[1], len(mesh.points)
        self.reach = farthest(sensor)
        self.kernels = kernels.kernels()
        reach = reachable(model, sensor, poses)
        nodes = [np.unique(mesh.faces[f]) for f in reach]
        batch, m, width = self.batch, len(own.points), max(1, max(len(n) for n in nodes))
        self.sides = make_sides(model, sensor, reach, nodes, width, device=device)
        self.width = width
        self._every = torch.arange(batch, device=device)
        listed = np.full((batch, width), -1, np.int64)
        rest = np.zeros((batch, width, 3))
        for b, n in enumerate(nodes):
            listed[b, :len(n)], rest[b, :len(n)] = n, mesh.points[n]

        def many(values: np.ndarray) -> np.ndarray:
            return np.broadcast_to(values, (batch, *values.shape))

        # degrees of freedom and rest positions of all surface nodes: the object's in reach, then the sensor's
        carried = 3 * (self.count + np.arange(m))[:, None] + np.arange(3)
        objects = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1)
        self.dof = torch.as_tensor(np.concatenate([objects, many(carried)], axis=1), device=device)  # (B, S, 3)
        self._rest = torch.as_tensor(np.concatenate([rest, many(own.points)], axis=1), device=device)
        free = torch.as_tensor(np.concatenate([model.free, sensor.free]), dtype=torch.float64, device=device)
        self._free = free[self.dof.clamp(min=0)] * (self.dof >= 0)
        # positions now, when the step began, and where the surfaces would be if both had kept their shapes
        self.x, self.x_before, self.x_swept = (self._rest.clone() for _ in range(3))
        self.near = torch.zeros((batch, width + m), dtype=torch.int32, device=device)
        self._moved_to: tuple[np.ndarray, torch.Tensor] | None = None

    def positions(self, u: torch.Tensor, pose: np.ndarray) -> torch.Tensor:
        """World positions (B, S, 3) [m] of all surface nodes for displacements u (3 N, B) [m] and the sensor at
        ``pose`` (B, 4, 4)."""
        index = self.dof.clamp(min=0).reshape(self.batch, -1)
        moved = u.gather(0, index.T).T.reshape(self._rest.shape) * (self.dof >= 0)
        out = self._rest + moved
        at = torch.as_tensor(pose, dtype=torch.float64, device=self.device)
        out[:, self.width:] = out[:, self.width:] @ at[:, :3, :3].mT + at[:, None, :3, 3]
        return out

    def carried(self, vectors: torch.Tensor, *, place: bool) -> torch.Tensor:
        """Vectors (m, 3, B) of the sensor's frame in the world, or points of it if ``place``, at the present pose."""
        out = torch.einsum("bij,mjb->mib", self.turn, vectors)
        return out + torch.as_tensor(self.pose[:, :3, 3].T, device=self.device) if place else out

    def origins(self, columns: torch.Tensor) -> torch.Tensor:
        """Origins of the sensor's frame (k, 1, 3) [m], world."""
        return torch.as_tensor(self.pose[:, None, :3, 3], device=self.device)[columns]

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        """Begin a step with the sensor at ``before`` (B, 1, 4, 4) and displacements u (3 N, B) [m]."""
        self._u_before, self._pose_before = u.clone(), before[:, 0]
        self.x_before.copy_(self.positions(u, before[:, 0]))

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> bool:
        """Move the sensor to ``pose`` (B, 1, 4, 4) and find what the touches ``columns`` (k,) may meet on the way; of
        the others nothing moves. Returns whether anything was new."""
        pose = pose[:, 0]
        if self._moved_to is not None:
            same_pose = np.array_equal(self._moved_to[0], pose)
            if same_pose and torch.equal(self._moved_to[1], self._u_before):
                return False
        self._moved_to = (pose.copy(), self._u_before)
        self.pose = pose
        self.turn = torch.as_tensor(pose[:, :3, :3], dtype=torch.float64, device=self.device)
        self.x_swept.copy_(self.positions(self._u_before, pose))
        self.x[columns] = self.x_swept[columns]
        change = pose - self._pose_before
        way = np.linalg.norm(change[:, :3, 3], axis=1) + self.reach * np.linalg.norm(change[:, :3, :3], axis=(1, 2))
        self.find_candidates(float(way.max()) + self.margin, columns, blend=columns)
        return True

    def displace(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Set the positions of the patches of ``columns`` (k,) to displacements (k, 3 s) [m], the sensor's in its
        frame."""
        patch = self.patch
        x = (patch.rest[columns] + displacement).view(len(columns), -1, 3)
        carried = x[:, patch.split:] @ self.turn[columns].mT + self.origins(columns)
        x = torch.cat([x[:, :patch.split], carried], dim=1)
        keep = patch.on[columns][:, :, None]
        old = self.x[columns]
        index = patch.nodes[columns][:, :, None].expand(-1, -1, 3)
        self.x[columns] = old.scatter(1, index, torch.where(keep, x, old.gather(1, index)))

    def place_at(self, columns: torch.Tensor, u: torch.Tensor) -> None:
        """Set the positions of all surface nodes of ``columns`` (k,) to displacements u (3 N, B) [m]."""
        self.x[columns] = self.positions(u, self.pose)[columns]

    def find_candidates(self, within: float, columns: torch.Tensor, *, blend: torch.Tensor) -> None:
        """Find the faces no further than ``within`` [m] from each node of ``columns`` (k,) at the present positions,
        and the patch that they make. The touches ``blend`` (j,) also get new normals."""
        k = self.kernels
        x = wp.from_torch(self.x, dtype=k.vec3)
        every, some = (wp.from_torch(which.to(torch.int32)) for which in (self._every, columns))
        self.near.zero_()
        for side in self.sides:
            size = side.tensors["stiffness"].shape
            wp.launch(k.search, dim=(size[1], len(columns)), device=self.device, inputs=[side.points, some, within, x])
            if len(blend):
                side.tensors["smooth"][blend] = side.blended(self.x)[blend]
            wp.launch(k.mark, dim=(size[1], size[0]), device=self.device,
                      inputs=[side.points, every, wp.from_torch(self.near)])
        self.patch = self._make_patch()

    def _make_patch(self) -> PairPatch:
        width = self.width
        chosen = []
        for start, stop in ((0, width), (width, self.near.shape[1])):
            near = self.near[:, start:stop]
            most = max(1, int(near.sum(dim=1).amax()))
            on, order = torch.sort(near, dim=1, descending=True, stable=True)
            chosen.append((order[:, :most] + start, on[:, :most] > 0))
        split = chosen[0][0].shape[1]
        nodes, on = torch.cat([c[0] for c in chosen], dim=1), torch.cat([c[1] for c in chosen], dim=1)
        place = torch.zeros(self.near.shape, dtype=torch.int64, device=self.device)
        place.scatter_(1, nodes, torch.arange(nodes.shape[1], device=self.device).expand_as(nodes).contiguous())
        index = nodes[:, :, None].expand(-1, -1, 3)
        dof = torch.where(on[:, :, None], self.dof.gather(1, index), -1).flatten(1)
        mask = (dof >= 0).to(torch.float64)
        three = torch.arange(3, device=self.device)
        return PairPatch(split, nodes, on, place, dof, mask, free=self._free.gather(1, index).flatten(1) * mask,
                         rest=self._rest.gather(1, index).flatten(1) * mask,
                         on_object=(3 * nodes[:, :split, None] + three).flatten(1),
                         on_sensor=(3 * (nodes[:, split:, None] - width) + three).flatten(1))


def farthest(sensor: Model) -> float:
    """How far the sensor's surface reaches from the origin of its frame [m]."""
    return float(np.linalg.norm(sensor.mesh.points, axis=1).max())
