"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

The unknowns are the displacements of the object's nodes in the world and, after them, those of the sensor's nodes in
the sensor's own frame: there its elements and its rest-state factor stay the same while it is carried along. A step
knows, for every node of either surface, the faces of the other surface that it may meet.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.intrusion import PairOverlap
from vsfsim.physics.contact.pair import kernels
from vsfsim.physics.contact.pair.sides import farthest, make_sides, reachable
from vsfsim.physics.contact.patch import first_of
from vsfsim.physics.contact.points import Contact
from vsfsim.physics.linear.rest_factor import RestFactor, response
from vsfsim.physics.model import Model

SENSOR_NODES = 3000
"""Largest number of nodes m of a sensor that touches an object: its compliance is kept whole, (3 m)^2 doubles."""
_TURNED = 0.01  # change of a blended normal [rad] in a step above which it is blended again
_NEW_GAP = 1e-9  # change of a gap [m] with renewed candidates above which the old one was wrong


class PairContact(Contact):
    """The contact of an object with the surface of a sensor (K = 1). The patch of a touch is the nodes of the object in
    reach, padded, and after them the m of the sensor: S in all. Methods without a description are those of
    `RigidContact`.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame; its displacements are 0 in the free state.
        factor: of both at rest.
        friction: Coulomb's coefficient of the pair [-].
        poses: all poses to come, sensor to world (T, B, 4, 4): they tell what is in reach.
        device: Warp device.
        margin: how far the surfaces may approach each other in a step by their own motion [m].
    """

    # with blended normals the forces are not quite those of a potential
    symmetric, potential_trusted_above, decrease = False, 1.0, 0.9
    # rubber mostly sticks
    friction_updated_below = 0.3
    solid, flat, follows = False, False, False

    rotation: torch.Tensor
    """Rotations of the sensor at present (B, 3, 3) [-]."""
    origin: torch.Tensor
    """Its origins (B, 1, 3) [m], world."""

    def __init__(self, model: Model, sensor: Model, factor: PairFactors, friction: float, poses: np.ndarray, *,
                 device: str, margin: float):
        self.device, self.batch, self.has_friction, self.kernels = (
            device, poses.shape[1], friction > 0.0, kernels.KERNELS)
        self._margin, self._reach = margin, farthest(sensor)
        reach, own = reachable(model, sensor, poses), sensor.mesh.points
        nodes = [np.unique(model.mesh.faces[f]) for f in reach]
        self.width = width = max(1, max(len(n) for n in nodes))
        listed = np.full((self.batch, width + len(own)), -1)
        listed[:, width:] = np.arange(len(own)) + len(model.mesh.points)
        for row, n in zip(listed, nodes, strict=True):
            row[:len(n)] = n
        self._take(listed, np.concatenate([model.free, sensor.free]), np.concatenate([model.mesh.points, own]))
        self._rest = self.rest.view(self.batch, -1, 3)
        # positions now, when the step began, and where the surfaces would be if both had kept their shapes
        self.x, self.x_before, self.x_swept = (self._rest.clone() for _ in range(3))
        self._moved = self._rest.new_zeros(self._rest.flatten(1).shape)
        self._pose_before = poses[0].copy()
        self._overlap, self.coulomb = (torch.zeros_like(self.mask[:, 0]) for _ in range(2))
        self.sides = make_sides(model, sensor, reach, nodes, width, {
            "coefficient": friction, "coulomb": self.coulomb, "x": self.x, "x_before": self.x_before,
            "x_swept": self.x_swept}, device=device)
        self._sets = [side.tensors for side in self.sides]
        self.response = response(factor, self.dof, device=device)
        self._passage = PairOverlap(model, sensor, device=device)
        # the touches whose points in contact were looked at last, and these
        self._known: tuple[torch.Tensor, list[torch.Tensor]] | None = None
        # whose normals were blended once more in this step
        self._blended = torch.zeros(self.batch, dtype=torch.bool, device=device)

    def _place(self, pose: np.ndarray) -> None:
        """Put the sensor at ``pose`` (B, 4, 4)."""
        at = torch.as_tensor(pose, dtype=torch.float64, device=self.device)
        self.rotation, self.origin = at[:, :3, :3], at[:, None, :3, 3]

    def _world(self, columns: torch.Tensor | slice, moved: torch.Tensor) -> torch.Tensor:
        """World positions (k, S, 3) [m] of the nodes of ``columns`` at displacements (k, 3 S) [m]."""
        out = self._rest[columns] + moved.view(len(moved), -1, 3)
        out[:, self.width:] = out[:, self.width:] @ self.rotation[columns].mT + self.origin[columns]
        return out

    def carried_by(self, vectors: torch.Tensor, *, place: bool) -> torch.Tensor:
        """Vectors (m, 3, B) of the sensor's frame in the world, or points of it if ``place``, at the present pose."""
        out = torch.einsum("bij,mjb->mib", self.rotation, vectors)
        return out + self.origin[:, 0].T if place else out

    def begin_step(self, before: np.ndarray, u: torch.Tensor, columns: torch.Tensor) -> None:
        at, before = columns.cpu().numpy(), before[:, 0]
        self._moved[columns], self._pose_before[at] = self.gather(u[:, columns], columns), before[at]
        self._place(before)
        self.x_before[columns] = self._world(columns, self._moved[columns])
        self._begin_friction(columns)

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> None:
        """See `RigidContact`; finds what the touches ``columns`` (k,) may meet on the way. The others keep what they
        met: their forces balance with that alone."""
        at, pose, self._known = columns.cpu().numpy(), pose[:, 0], None
        self._place(pose)
        self._overlap[columns], self._blended[columns] = 0.0, False
        self.x_swept[columns] = self._world(columns, self._moved[columns])
        self.x[columns] = self.x_swept[columns]
        change = (pose - self._pose_before)[at]
        way = np.linalg.norm(change[:, :3, 3], axis=1) + self._reach * np.linalg.norm(change[:, :3, :3], axis=(1, 2))
        self._find_candidates(float(way.max()) + self._margin, columns, blend=columns)

    def _find_candidates(self, within: float, columns: torch.Tensor, *, blend: torch.Tensor) -> None:
        """Find the faces no further than ``within`` [m] from each node of ``columns`` (k,) at the present positions.
        The touches ``blend`` (j,) also get new normals."""
        self._launch(kernels.search, columns, within)
        for side in self.sides if len(blend) else ():
            side.tensors["smooth"][blend] = side.blended(self.x)[blend]

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`; finds what may meet what again from where the surfaces are now. True of a touch for which
        that finds new contact, or normals that have turned."""
        before, moved = self._all("gap", columns).clamp(max=0.0), self.gather(u[:, columns], columns)
        self.x[columns] = self._world(columns, moved)
        turned = (self._turned() & ~self._blended)[columns]
        self._blended[columns[turned]] = True  # once in a step: more would chase the last digit
        self._find_candidates(self._margin, columns, blend=columns[turned])
        self.evaluate(columns, moved)
        change = self._all("gap", columns).clamp(max=0.0) - before
        grown = turned | (change.abs() > _NEW_GAP).any(dim=1)
        if not grown.all():
            self._overlap[columns[~grown]] = self.overlap(columns[~grown], u)
        return grown

    def overlap(self, columns: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """How deep the surfaces of ``columns`` (k,) lie in one another at displacements u (3 N, B) [m]: (k,) [m]."""
        return self._passage.check(columns, self.rotation[columns], self.origin[columns], u)

    def _turned(self) -> torch.Tensor:
        """Whose normals have turned where they touch since they were blended (B,) bool."""
        out = torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        for side in self.sides:
            at, node = (side.tensors["gap"] < 0.0).nonzero(as_tuple=True)
            face = side.tensors["body"][at, node].long()
            change = side.blended(self.x)[at, face] - side.tensors["smooth"][at, face]
            change = change.norm(dim=2).amax(dim=1)
            out[at[change > _TURNED]] = True
        return out

    def _launch(self, kernel: Any, columns: torch.Tensor, *more: float) -> None:
        for side in self.sides:
            wp.launch(kernel, dim=(side.tensors["stiffness"].shape[1], len(columns)), device=self.device,
                      inputs=[side.points, wp.from_torch(columns.to(torch.int32)), *more])

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        self.x[columns] = self._world(columns, displacement)
        self._launch(self.kernels.evaluate, columns)
        self._known = None

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """See `RigidContact`; nodes have no area, and the radius is not measured."""
        none = torch.full((len(columns),), torch.nan, dtype=torch.float64, device=self.device)
        return self._inside(columns).sum(dim=1), none, none[:, None], none[:, None]

    def _found(self, columns: torch.Tensor) -> list[torch.Tensor]:
        """The points in contact of ``columns`` (k,) as they were evaluated last, p parts of one point each: a node and
        its place on the other side (k, p, 7), their weights (k, p, 1, 7), force (k, p, 3) [N] and stiffness
        (k, p, 3, 3) [N/m]. Pressure acts at the nearest place, friction at the anchor."""
        if self._known is not None and torch.equal(self._known[0], columns):
            return self._known[1]
        parts = []
        for side in self.sides:
            on = (side.tensors["gap"][columns] < 0.0) | (side.tensors["limit"][columns] > 0.0)
            node = first_of(on)
            chosen = on.gather(1, node).to(torch.float64)
            for names in (("body", "there", "force", "stiff"), ("owner", "anchor", "drag", "drag_stiff")):
                there, weight, pull, stiffness = (side.tensors[name][columns[:, None], node] for name in names)
                there = torch.where(there < -1, -2 - there, there)  # an owner that may still move
                corners = side.tensors["faces"][columns[:, None], there.long().clamp(min=0)].long()
                nodes = torch.cat([side.first + node[:, :, None], corners], dim=2)
                parts.append((torch.nn.functional.pad(nodes, (0, 7 - nodes.shape[2])),
                              torch.cat([torch.ones_like(weight[:, :, :1]), -weight], dim=2)[:, :, None],
                              pull * chosen[:, :, None], stiffness * chosen[:, :, None, None]))
        self._known = columns.clone(), [torch.cat(each, dim=1) for each in zip(*parts, strict=True)]
        return self._known[1]

    def faces(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        nodes, weights, *_ = self._found(columns)
        return nodes, weights

    def own_stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> torch.Tensor:
        """See `RigidContact`; it has no geometric term."""
        return self._found(columns)[3]

    @property
    def turn(self) -> tuple[int, torch.Tensor]:
        return self.width, self.rotation

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`; in the frames of the unknowns."""
        out = self.nodal_of(columns, self._found(columns)[2]).view(len(columns), -1, 3)
        out[:, self.width:] = out[:, self.width:] @ self.rotation[columns]
        return out.flatten(1)

    def _on_sensor(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces on the sensor's nodes (k, m, 3) [N], world."""
        own = self.nodal(columns).view(len(columns), -1, 3)[:, self.width:]
        return own @ self.rotation[columns].mT

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`: the force on the sensor (k, 1, 3) [N]."""
        return self._on_sensor(columns).sum(dim=1, keepdim=True)

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`: the moment on the sensor (k, 1, 3) [N m]."""
        lever = self.x[columns][:, self.width:] - self.origin[columns]
        return torch.linalg.cross(lever, self._on_sensor(columns)).sum(dim=1, keepdim=True)


class PairFactors:
    """The rest-state factors of two bodies that do not touch, as one `RestFactor`: their degrees of freedom one after
    the other.

    Args:
        bodies: the factors of both.
    """

    def __init__(self, *bodies: RestFactor):
        self._bodies, self.free = bodies, np.concatenate([body.free for body in bodies])
        self.size, self._split = len(self.free), bodies[0].size

    @property
    def real(self) -> type:
        """See `RestFactor`."""
        return np.float64 if any(body.real is np.float64 for body in self._bodies) else np.float32

    def solve(self, right: np.ndarray, *, exactly: bool = True) -> np.ndarray:
        """See `RestFactor`."""
        parts = zip(self._bodies, np.split(right, [self._split]), strict=True)
        return np.concatenate([body.solve(own) if exactly else body.apply(own) for body, own in parts])

    apply = functools.partialmethod(solve, exactly=False)
    """See `RestFactor`."""

    def columns(self, nodes: np.ndarray) -> np.ndarray:
        """See `RestFactor`; bodies do not move one another."""
        out, first = np.zeros((3 * len(nodes), self.size)), 3 * nodes < self._split
        out[np.repeat(first, 3), :self._split] = self._bodies[0].columns(nodes[first])
        out[np.repeat(~first, 3), self._split:] = self._bodies[1].columns(nodes[~first] - self._split // 3)
        return out

    def dense(self, device: str) -> torch.Tensor:
        """See `RestFactor`."""
        return torch.block_diag(*(body.dense(device) for body in self._bodies))
