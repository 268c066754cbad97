"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

A step knows, for every node of either surface, the faces of the other surface that it may meet (`surfaces`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.pair.overlap import PairOverlap
from vsfsim.physics.contact.pair.response import PairResponse
from vsfsim.physics.contact.pair.surfaces import PairSurfaces
from vsfsim.physics.contact.points import ContactPoints
from vsfsim.physics.model import Model

_TURNED = 0.01  # change of a blended normal [rad] in a step above which it is blended again
_NEW_GAP = 1e-9  # change of a gap [m] with renewed candidates above which the old one was wrong


class PairContact(ContactPoints):
    """The contact of an object with the surface of a sensor (K = 1); the patch of a touch is all nodes of `surfaces`.
    Methods without a description are those of `RigidContact`.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame; its displacements are 0 in the free state.
        friction: Coulomb's coefficient of the pair [-].
        poses: all poses to come, sensor to world (T, B, 4, 4): they tell what is in reach.
        device: Warp device.
        stride: longest way of the sensor in a step [m].
    """

    # with blended normals the forces are not quite those of a potential
    symmetric, potential_trusted_above, decrease = False, 1.0, 0.9
    # rubber mostly sticks
    friction_updated_below = 0.3
    solid, flat = False, False
    _memory = "anchored", "anchor_face", "anchor_shape", "limit", "across"

    def __init__(self, model: Model, sensor: Model, friction: float, poses: np.ndarray, *, device: str, stride: float):
        self.model, self.sensor, self.device = model, sensor, device
        self.has_friction = friction > 0.0
        self.surfaces = PairSurfaces(model, sensor, friction, poses, device=device, stride=stride)
        self._sides, self.kernels, self.batch = self.surfaces.sides, self.surfaces.kernels, self.surfaces.batch
        self._sets = [side.tensors for side in self._sides]
        self.follows, self.coulomb = False, torch.zeros(self.batch, dtype=torch.float64, device=device)
        self.response = PairResponse(model, sensor, self.surfaces)
        self.dof, self.mask, self.free = self.surfaces.dof, self.surfaces.mask, self.surfaces.free
        self._passage = PairOverlap(model, sensor, device=device)
        self._overlap = torch.zeros(self.batch, dtype=torch.float64, device=device)
        # the touches whose points in contact were looked at last, and these
        self._known: tuple[torch.Tensor, list[torch.Tensor]] | None = None
        # whose normals were blended once more in this step
        self._blended = torch.zeros(self.batch, dtype=torch.bool, device=device)

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        self._begin_friction()
        self.surfaces.begin_step(before, self.gather(u))

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> None:
        """See `RigidContact`; finds what the touches ``columns`` (k,) may meet on the way."""
        self._overlap[columns], self._known = 0.0, None
        if self.surfaces.move(pose, columns):
            self._blended[columns] = False

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> bool:
        """See `RigidContact`: finds what may meet what again from where the surfaces are now. True if that finds new
        contact, or normals that have turned."""
        before = [side.tensors["gap"][columns].clamp(max=0.0) for side in self._sides]
        self.surfaces.displace(columns, self.gather(u)[columns])
        turned = columns[(self._turned() & ~self._blended)[columns]]
        self._blended[turned] = True  # once in a step: more would chase the last digit
        self.surfaces.find_candidates(self.surfaces.margin, columns, blend=turned)
        self.evaluate(columns, self.gather(u)[columns])
        if len(turned) > 0 or any(bool(((old - side.tensors["gap"][columns].clamp(max=0.0)).abs() > _NEW_GAP).any())
                                  for side, old in zip(self._sides, before, strict=True)):
            return True
        self._overlap[columns] = self.overlap(columns, u)
        return False

    def overlap(self, columns: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """How deep the surfaces of ``columns`` (k,) lie in one another at displacements u (3 N, B) [m]: (k,) [m]."""
        return self._passage.check(columns, self.surfaces.turn[columns], self.surfaces.origin[columns], u)

    def _turned(self) -> torch.Tensor:
        """Whose normals have turned where they touch since they were blended (B,) bool."""
        out = torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        for side in self._sides:
            at, node = (side.tensors["gap"] < 0.0).nonzero(as_tuple=True)
            face = side.tensors["face"][at, node].long()
            change = side.blended(self.surfaces.x)[at, face] - side.tensors["smooth"][at, face]
            change = change.norm(dim=2).amax(dim=1)
            out[at[change > _TURNED]] = True
        return out

    def _launch(self, kernel: Any, columns: torch.Tensor) -> None:
        for side in self._sides:
            wp.launch(kernel, dim=(side.tensors["stiffness"].shape[1], len(columns)), device=self.device,
                      inputs=[side.points, wp.from_torch(columns.to(torch.int32))])

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        self.surfaces.displace(columns, displacement)
        self._launch(self.kernels.evaluate, columns)
        self._known = None

    def carried(self, columns: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(self._overlap[columns])

    local_energy = carried  # its elements show all of it

    def reach(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(self._overlap[columns])

    def follow(self) -> bool:
        return False

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """See `RigidContact`; nodes have no area, and the radius is not measured."""
        none = torch.full((len(columns),), torch.nan, dtype=torch.float64, device=self.device)
        return self._inside(columns).sum(dim=1), none, none[:, None]

    def _found(self, columns: torch.Tensor) -> list[torch.Tensor]:
        """The points in contact of ``columns`` (k,) as they were evaluated last, p parts of one point each: a node and
        its place on the other side (k, p, 7), their weights (k, p, 1, 7), force (k, p, 3) [N] and stiffness
        (k, p, 3, 3) [N/m]. Pressure acts at the nearest place, friction at the anchor."""
        if self._known is not None and torch.equal(self._known[0], columns):
            return self._known[1]
        parts = []
        for side in self._sides:
            on = (side.tensors["gap"][columns] < 0.0) | (side.tensors["limit"][columns] > 0.0)
            most = int(on.sum(dim=1).amax())
            chosen, order = torch.sort(on.to(torch.int8), dim=1, descending=True, stable=True)
            node, chosen = order[:, :most], chosen[:, :most].to(torch.float64)
            for face, shape, force in (("face", "shape", "push"), ("anchor_face", "anchor_shape", "drag")):
                there, weight, pull, stiffness = (side.tensors[name][columns[:, None], node] for name in (
                    face, shape, force, f"{force}_stiffness"))
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
        return self.surfaces.width, self.surfaces.turn

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`; in the frames of the unknowns."""
        out = self.nodal_of(columns, self._found(columns)[2]).view(len(columns), -1, 3)
        out[:, self.surfaces.width:] = out[:, self.surfaces.width:] @ self.surfaces.turn[columns]
        return out.flatten(1)

    def _on_sensor(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces on the sensor's nodes (k, m, 3) [N], world."""
        own = self.nodal(columns).view(len(columns), -1, 3)[:, self.surfaces.width:]
        return own @ self.surfaces.turn[columns].mT

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`: the force on the sensor (k, 1, 3) [N]."""
        return self._on_sensor(columns).sum(dim=1, keepdim=True)

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`: the moment on the sensor (k, 1, 3) [N m]."""
        lever = self.surfaces.x[columns][:, self.surfaces.width:] - self.surfaces.origin[columns]
        return torch.linalg.cross(lever, self._on_sensor(columns)).sum(dim=1, keepdim=True)
