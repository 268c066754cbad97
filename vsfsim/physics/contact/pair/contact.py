"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

A step knows, for every node of either surface, the faces of the other surface that it may meet; all their nodes are the
*patch* of the step (`surfaces`). It is small, and differs from step to step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.contact.pair.chosen_nodes import ChosenNodes
from vsfsim.physics.contact.pair.links import LinkBlock, Links, LinkStiffness
from vsfsim.physics.contact.pair.overlap import PairOverlap
from vsfsim.physics.contact.pair.response import PairResponse
from vsfsim.physics.contact.pair.sides import Side
from vsfsim.physics.contact.pair.surfaces import PairSurfaces
from vsfsim.physics.contact.rigid_kernels import STICK
from vsfsim.physics.model import Model

_TURNED = 0.01  # change of a blended normal [rad] in a step above which it is blended again
_NEW_GAP = 1e-9  # change of a gap [m] with renewed candidates above which the old one was wrong


@dataclass(frozen=True)
class _Evaluated:
    """The points in contact of some touches, as they were evaluated last."""

    columns: torch.Tensor
    """The touches (k,)."""
    normal: Links | None
    """Links along the normals; their rows carry the roots of the stiffness."""
    across: Links | None
    """Links across the normals, with friction only."""
    push: torch.Tensor
    """Nodal normal forces (k, 3 s) [N]."""
    drag: torch.Tensor
    """Nodal friction forces (k, 3 s) [N]."""


class PairContact(Contact):
    """`Contact` of an object with the surface of a sensor (K = 1); the patch is that of the present step.

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
    # rubber mostly sticks, and the limits of the prediction are nearly right
    friction_updated_below = 0.3
    # over flat facets a step may cycle, and half of such steps end elsewhere
    patience, solid, flat = 8, False, False

    def __init__(self, model: Model, sensor: Model, friction: float, poses: np.ndarray, *, device: str, stride: float):
        self.model, self.sensor, self.device = model, sensor, device
        self.has_friction, self._coefficient = friction > 0.0, float(friction)
        self.surfaces = PairSurfaces(model, sensor, poses, device=device, stride=stride)
        self._sides, self._kernels, self.batch = self.surfaces.sides, self.surfaces.kernels, self.surfaces.batch
        self.follows_below, self.coulomb = 0.0, torch.zeros(self.batch, dtype=torch.float64, device=device)
        self.softening = torch.ones(self.batch, dtype=torch.float64, device=device)
        for side in self._sides:
            side.points.softening = wp.from_torch(self.softening)
        self.response = PairResponse(model, sensor, self.surfaces)
        self._passage = PairOverlap(model, sensor, device=device)
        self._overlap = torch.zeros(self.batch, dtype=torch.float64, device=device)
        self._evaluated: _Evaluated | None = None
        # whose normals were blended once more in this step
        self._blended = torch.zeros(self.batch, dtype=torch.bool, device=device)

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        for side in self._sides:
            side.relaxation.begin_step()
        self.surfaces.begin_step(before, u)

    def move(self, pose: np.ndarray, columns: torch.Tensor) -> None:
        """See `Contact`; finds what the touches ``columns`` (k,) may meet on the way."""
        self._overlap[columns] = 0.0
        if self.surfaces.move(pose, columns):
            self._blended[columns] = False
            self._use_patch()

    def _use_patch(self) -> None:
        self._patch = self.surfaces.patch
        self.dof, self.mask, self.free = self._patch.dof, self._patch.mask, self._patch.free
        self.compliance = self.response.compliance()
        self._evaluated = None

    def _find_candidates(self, columns: torch.Tensor, *, blend: torch.Tensor) -> None:
        self.surfaces.find_candidates(self.surfaces.margin, columns, blend=blend)
        self._use_patch()

    def predict_candidates(self, columns: torch.Tensor, u: torch.Tensor) -> None:
        """Find what may meet what again, with the normals at the predicted displacements u (3 N, B) [m]."""
        self.surfaces.place_at(columns, u)
        self._find_candidates(columns, blend=columns)

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, *,
                     touched: torch.Tensor | None = None) -> bool:
        """See `Contact`: finds what may meet what again from where the surfaces are now. True if that finds new
        contact, or normals that have turned."""
        before = [side.tensors["gap"][columns].clamp(max=0.0) for side in self._sides]
        self.surfaces.place_at(columns, u)
        turned = columns[(self._turned() & ~self._blended)[columns]]
        self._blended[turned] = True  # once in a step: more would chase the last digit
        self._find_candidates(columns, blend=turned)
        self.evaluate(columns, self.gather(u)[columns])
        if len(turned) > 0 or any(bool(((old - side.tensors["gap"][columns].clamp(max=0.0)).abs() > _NEW_GAP).any())
                                  for side, old in zip(self._sides, before, strict=True)):
            return True
        self._overlap[columns] = self._passage.check(columns, self.surfaces.turn[columns],
                                                     self.surfaces.origins(columns), u)
        return False

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
        self._evaluated = None

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
        """See `Contact`; empty without friction."""
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

    def wrong_side(self, columns: torch.Tensor) -> torch.Tensor:
        return self._sum("wrong_side", columns)

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        return torch.stack([(side.tensors["gap"][columns] < 0.0).any(dim=1) for side in self._sides]).any(dim=0)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`: over the nodes, and between them at the last `extend_patch`."""
        at_nodes = torch.stack([-side.tensors["gap"][columns].amin(dim=1) for side in self._sides]).amax(dim=0)
        return torch.maximum(at_nodes, self._overlap[columns]).clamp(min=0.0)

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """See `Contact`; nodes have no area, and the radius is not measured."""
        points = torch.stack([(side.tensors["gap"][columns] < 0.0).sum(dim=1) for side in self._sides]).sum(dim=0)
        none = torch.full((len(columns),), torch.nan, dtype=torch.float64, device=self.device)
        return points, none, none[:, None]

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        # a point that has left may still have a limit in this step
        inside = [side.tensors["gap"][columns] < 0.0 for side in self._sides]
        slips = sum((side.tensors["slips"][columns] * on).sum(dim=1)
                    for side, on in zip(self._sides, inside, strict=True))
        return slips / sum(on.sum(dim=1) for on in inside).clamp(min=1)

    def _in_contact(self, columns: torch.Tensor) -> _Evaluated:
        """The points in contact, as they were evaluated last."""
        if self._evaluated is not None and torch.equal(self._evaluated.columns, columns):
            return self._evaluated
        none = torch.zeros((len(columns), self.dof.shape[1]), dtype=torch.float64, device=self.device)
        self._evaluated = _Evaluated(columns.clone(), None, None, none, none)
        chosen = ChosenNodes(self.surfaces, columns, [
            (side.tensors["gap"][columns] < 0.0) | (side.memory["limit"][columns] > 0.0) for side in self._sides])
        if chosen:
            roots, axes = chosen.of("rows"), torch.eye(3, dtype=torch.float64, device=self.device)
            axes, first = axes.expand(*roots.shape[:2], 3, 3), roots[:, :, :1]
            normal = chosen.links("face", "shape", first,
                                  first.norm(dim=3, keepdim=True) * chosen.of("slope")[:, :, None])
            push = chosen.links("face", "shape", axes).push(chosen.of("push").flatten(1))
            across, drag = None, none
            if self.has_friction:
                across = chosen.links("anchor_face", "anchor_shape", roots[:, :, 1:])
                drag = chosen.links("anchor_face", "anchor_shape", axes).push(chosen.of("drag").flatten(1))
            self._evaluated = _Evaluated(self._evaluated.columns, normal, across, push, drag)
        return self._evaluated

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`; in the frames of the unknowns."""
        found = self._in_contact(columns)
        return found.push + found.drag

    def _on_sensor(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces on the sensor's nodes of the patches (k, c, 3) [N], world."""
        own = self.nodal(columns).view(len(columns), -1, 3)[:, self._patch.split:]
        return own @ self.surfaces.turn[columns].mT

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`: the force on the sensor (k, 1, 3) [N]."""
        return self._on_sensor(columns).sum(dim=1, keepdim=True)

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`: the moment on the sensor (k, 1, 3) [N m]."""
        index = self._patch.nodes[columns][:, self._patch.split:, None].expand(-1, -1, 3)
        lever = self.surfaces.x[columns].gather(1, index) - self.surfaces.origins(columns)
        return torch.linalg.cross(lever, self._on_sensor(columns)).sum(dim=1, keepdim=True)

    def stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> LinkStiffness:
        """See `Contact`: an operator, not symmetric. It has no geometric term, and ``geometric`` is ignored."""
        return LinkStiffness(self._all_links(columns), self.free[columns])

    def block(self, columns: torch.Tensor) -> LinkBlock:
        links = self._all_links(columns)
        assert links is not None, "the contact block exists only where there is contact"
        return LinkBlock.of(links, self.compliance, columns, self.free[columns])

    def _all_links(self, columns: torch.Tensor) -> Links | None:
        found = self._in_contact(columns)
        return found.normal if found.normal is None or found.across is None else found.normal.beside(found.across)
