"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

A step knows, for every node of either surface, the faces of the other surface that it may meet (`surfaces`).
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.pair.links import LinkBlock, Links, LinkStiffness
from vsfsim.physics.contact.pair.overlap import PairOverlap
from vsfsim.physics.contact.pair.response import PairResponse
from vsfsim.physics.contact.pair.sides import Side
from vsfsim.physics.contact.pair.surfaces import PairSurfaces
from vsfsim.physics.contact.patch import OnPatches
from vsfsim.physics.contact.rigid_kernels import STICK
from vsfsim.physics.model import Model

_TURNED = 0.01  # change of a blended normal [rad] in a step above which it is blended again
_NEW_GAP = 1e-9  # change of a gap [m] with renewed candidates above which the old one was wrong


class PairContact(OnPatches):
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

    def __init__(self, model: Model, sensor: Model, friction: float, poses: np.ndarray, *, device: str, stride: float):
        self.model, self.sensor, self.device = model, sensor, device
        self.has_friction, self._coefficient = friction > 0.0, float(friction)
        self.surfaces = PairSurfaces(model, sensor, poses, device=device, stride=stride)
        self._sides, self._kernels, self.batch = self.surfaces.sides, self.surfaces.kernels, self.surfaces.batch
        self.follows, self.coulomb = False, torch.zeros(self.batch, dtype=torch.float64, device=device)
        self.softening = torch.ones(self.batch, dtype=torch.float64, device=device)
        for side in self._sides:
            side.points.softening = wp.from_torch(self.softening)
        self.response = PairResponse(model, sensor, self.surfaces)
        self.dof, self.mask, self.free = self.surfaces.dof, self.surfaces.mask, self.surfaces.free
        self._passage = PairOverlap(model, sensor, device=device)
        self._overlap = torch.zeros(self.batch, dtype=torch.float64, device=device)
        # the touches whose points in contact were looked at last, their links, and the nodal forces
        self._known: tuple[torch.Tensor, Links | None, torch.Tensor] | None = None
        # whose normals were blended once more in this step
        self._blended = torch.zeros(self.batch, dtype=torch.bool, device=device)

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        for side in self._sides:
            side.relaxation.begin_step()
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

    def _launch(self, kernel: Any, side: Side, columns: torch.Tensor, *more: Any) -> None:
        """Run a kernel over the nodes of a side of the touches ``columns`` (k,)."""
        wp.launch(kernel, dim=(side.tensors["stiffness"].shape[1], len(columns)), device=self.device,
                  inputs=[side.points, wp.from_torch(columns.to(torch.int32)), *more])

    def _positions(self, x: torch.Tensor) -> wp.array:
        return wp.from_torch(x, dtype=self._kernels.vec3)

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        self.surfaces.displace(columns, displacement)
        for side in self._sides:
            self._launch(self._kernels.evaluate, side, columns, STICK, self._positions(self.surfaces.x))
        self._known = None

    def update_friction(self, columns: torch.Tensor) -> None:
        if not self.has_friction:
            return
        for side in self._sides:
            side.relaxation.renewals[columns] += 1
            self._launch(self._kernels.update_friction, side, columns, self._coefficient,
                         self._positions(self.surfaces.x_before), self._positions(self.surfaces.x_swept))

    def friction_residual(self, columns: torch.Tensor) -> torch.Tensor:
        return sum(side.relaxation.friction_residual(columns) for side in self._sides)

    def end_step(self, columns: torch.Tensor) -> None:
        if not self.has_friction or not len(columns):
            return
        for side in self._sides:
            self._launch(self._kernels.end_step, side, columns, STICK, self._positions(self.surfaces.x))

    def friction_state(self) -> list[dict[str, torch.Tensor]]:
        """See `RigidContact`; empty without friction."""
        if not self.has_friction:
            return []
        return [{key: value.clone() for key, value in side.memory.items()} for side in self._sides]

    def restore_friction(self, columns: torch.Tensor, state: list[dict[str, torch.Tensor]]) -> None:
        for side, kept in zip(self._sides, state, strict=False):
            for key, value in kept.items():
                side.memory[key][columns] = value[columns]

    def _sum(self, name: str, columns: torch.Tensor) -> torch.Tensor:
        return sum(side.tensors[name][columns].sum(dim=1) for side in self._sides)

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        return self._sum("energy", columns)

    def carried(self, columns: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(self.softening[columns])

    local_energy = carried  # its elements show all of it

    def reach(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(self.softening[columns])

    def follow(self) -> bool:
        return False

    def wrong_side(self, columns: torch.Tensor) -> torch.Tensor:
        return self._sum("wrong_side", columns)

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        return torch.stack([(side.tensors["gap"][columns] < 0.0).any(dim=1) for side in self._sides]).any(dim=0)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`: over the nodes, and between them at the last `extend_patch`."""
        at_nodes = torch.stack([-side.tensors["gap"][columns].amin(dim=1) for side in self._sides]).amax(dim=0)
        return torch.maximum(at_nodes, self._overlap[columns]).clamp(min=0.0)

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """See `RigidContact`; nodes have no area, and the radius is not measured."""
        points = torch.stack([(side.tensors["gap"][columns] < 0.0).sum(dim=1) for side in self._sides]).sum(dim=0)
        none = torch.full((len(columns),), torch.nan, dtype=torch.float64, device=self.device)
        return points, none, none[:, None]

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        # a point that has left may still have a limit in this step
        inside = [side.tensors["gap"][columns] < 0.0 for side in self._sides]
        slips = sum((side.tensors["slips"][columns] * on).sum(dim=1)
                    for side, on in zip(self._sides, inside, strict=True))
        return slips / sum(on.sum(dim=1) for on in inside).clamp(min=1)

    def _links(self, columns: torch.Tensor) -> tuple[Links | None, torch.Tensor]:
        """Links of the points in contact of ``columns`` (k,), along and across the normals, as they were evaluated
        last, with the roots of the stiffness; and the nodal forces (k, 3 s) [N]."""
        if self._known is not None and torch.equal(self._known[0], columns):
            return self._known[1:]
        links, force = None, torch.zeros_like(self.free[columns])
        for side in self._sides:
            on = (side.tensors["gap"][columns] < 0.0) | (side.memory["limit"][columns] > 0.0)
            if not (most := int(on.sum(dim=1).amax())):
                continue
            chosen, order = torch.sort(on.to(torch.int8), dim=1, descending=True, stable=True)
            points = _Points(self.surfaces, side, columns, order[:, :most], chosen[:, :most] > 0)
            roots = points.of("rows")
            first, axes = roots[:, :, :1], torch.eye(3, dtype=torch.float64, device=self.device).expand_as(roots)
            rows = [points.links("face", "shape", first,
                                 first.norm(dim=3, keepdim=True) * points.of("slope")[:, :, None])]
            force = force + points.links("face", "shape", axes).push(points.of("push").flatten(1))
            if self.has_friction:
                at = "anchor_face", "anchor_shape"
                rows.append(points.links(*at, roots[:, :, 1:]))
                force = force + points.links(*at, axes).push(points.of("drag").flatten(1))
            for more in rows:
                links = more if links is None else links.beside(more)
        self._known = columns.clone(), links, force
        return links, force

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """See `RigidContact`; in the frames of the unknowns."""
        return self._links(columns)[1]

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

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> LinkStiffness:
        """See `RigidContact`: an operator, not symmetric. It has no geometric term, and ``geometric`` is ignored."""
        return LinkStiffness(self._links(columns)[0], self.free[columns])

    def block(self, columns: torch.Tensor) -> LinkBlock:
        links, _ = self._links(columns)
        assert links is not None, "the contact block exists only where there is contact"
        return LinkBlock.of(links, functools.partial(self.response.between, columns), self.free[columns])


class _Points:
    """Some nodes of one side of k touches, padded to a.

    Args:
        surfaces: the two surfaces.
        side: the side.
        columns: touches (k,).
        node: the nodes, by their numbers on this side (k, a).
        on: whether an entry is a node, and no padding (k, a) bool.
    """

    def __init__(self, surfaces: PairSurfaces, side: Side, columns: torch.Tensor, node: torch.Tensor, on: torch.Tensor):
        self._surfaces, self._side, self._columns, self._node, self._on = surfaces, side, columns, node, on

    def of(self, name: str) -> torch.Tensor:
        """The values of the array ``name`` of `Side` at these nodes (k, a, ...), 0 at padding."""
        values = self._side.tensors[name][self._columns[:, None], self._node]
        return values * self._on.view(*self._on.shape, *[1] * (values.dim() - 2)).to(values.dtype)

    def links(self, face: str, shape: str, world: torch.Tensor, slope: torch.Tensor | None = None) -> Links:
        """Their links to places on the other side, by the names of the arrays that say where.

        Args:
            face, shape: names of the faces (k, a) and the shape values on them (k, a, 6).
            world: directions in the world (k, a, m, 3).
            slope: those along which a displacement counts, likewise; None for the same.
        """
        side, surfaces, columns = self._side, self._surfaces, self._columns
        there = self.of(face).long() - (~self._on).long()
        weight = torch.cat([torch.ones_like(there)[:, :, None], -self.of(shape)], dim=2) * self._on[:, :, None]
        weight[:, :, 1:] *= (there >= 0)[:, :, None]
        node = torch.zeros(weight.shape, dtype=torch.int64, device=there.device)
        node[:, :, 0] = side.first + self._node
        found = side.tensors["faces"][columns[:, None], there.clamp(min=0)].long()
        node[:, :, 1:1 + found.shape[2]] = found
        return Links.of(surfaces.width, surfaces.dof.shape[1] // 3, node, weight, surfaces.turn[columns], world, slope)
