"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

The counterpart of `touching` for two deformable bodies, with the same interface, so that the same solver works on it.
The unknowns are the displacements of the object's nodes in the world and, after them, those of the sensor's nodes in
the sensor's own frame: there its elements and its rest-state factor do not change while it is carried along.

A step knows, for every point, the faces of the other surface that it may meet (`search`); the nodes of these are the
*patch* of the step. It is small, and another one in every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import pair_condensed
from vsfsim.physics.contact import rigid_points as contact
from vsfsim.physics.contact.pair_links import LinkBlock, Links, LinkStiffness
from vsfsim.physics.contact.pair_surfaces import PairSurfaces, Side

_TURNED = 0.01  # rad: normals that turn by more in a step are blended anew
_FOUND = 1e-9  # m: a gap that changes by more when the faces are looked up anew was wrong


@dataclass(frozen=True)
class _Contact:
    """The points in contact of the touches ``columns`` (k,): links along the normals and across them, whose rows carry
    the roots of the stiffness, and the nodal forces of both (k, 3 s) [N]."""

    columns: torch.Tensor
    normal: Links | None
    across: Links | None
    push: torch.Tensor
    drag: torch.Tensor


@dataclass(frozen=True)
class _Chosen:
    """Some nodes of a side, padded to the most of any touch. at: touches (k, 1) and nodes (k, a). on: 0 where padded
    (k, a)."""

    side: Side
    at: tuple[torch.Tensor, torch.Tensor]
    on: torch.Tensor

    def of(self, name: str) -> torch.Tensor:
        """What the kernels wrote for them (k, a, ...)."""
        return self.side.state[name][self.at]

    def stiffness(self) -> torch.Tensor:
        """Of their contact (k, a) [N/m]."""
        return self.side.stiffness[self.at]

    def anchor(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Where friction holds them: a face (k, a) and shape values (k, a, 6)."""
        return self.side.memory["anchor_face"][self.at], self.side.memory["anchor_shape"][self.at]


class PairTouching(PairSurfaces):
    """Contact state of B touches of an object by a sensor's surface.

    The attributes dof, free, real, rest, compliance and response are those of the present step's patch; see `Touching`
    for them and for the methods that have the same names.

    Args:
        model: the object. sensor: the body with the touching surface, in its own frame (free displacements there).
        friction: Coulomb's coefficient of the pair [-]. poses: sensor to world (T, B, 4, 4), to find what is in reach.
        device: Warp device.
        stride: longest way of the sensor in a step [m].
    """

    # see `Touching`: with blended normals the forces are not quite those of a potential
    near_balance, shrinks = 1.0, 0.9
    within = 0.3  # see `Touching`: rubber mostly sticks, and the limits are those of the prediction already
    patience = 8  # see `Touching`: from flat facets a step may go round in a circle, and half of it ends elsewhere

    # ------------------------------------------------------------------------------------------ evaluation

    def gather(self, u: torch.Tensor) -> torch.Tensor:
        """Displacements (B, 3 s) [m] of the patches out of u (3 N, B), the sensor's in its frame."""
        return u.gather(0, self._index.T).T.to(torch.float64) * self.real

    def _launch(self, kernel: Any, side: Side, columns: torch.Tensor, inputs: list[Any]) -> None:
        """Run a kernel over the nodes of a side of the touches ``columns`` (k,); its first three arguments are those
        that all have."""
        common = [side.faces.shape[2], wp.from_torch(columns.to(torch.int32)), side.first]
        wp.launch(kernel, dim=(side.stiffness.shape[1], len(columns)), device=self.device, inputs=[*common, *inputs])

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Gaps, forces and stiffness of the touches ``columns`` (k,) for displacements (k, 3 s) [m] of their
        patches."""
        k = self.kernels
        x = (self.rest[columns] + displacement).view(len(columns), -1, 3)
        carried = x[:, self._split:] @ self._turn[columns].mT + torch.as_tensor(self._pose[:, None, :3, 3],
                                                                                device=self.device)[columns]
        nodes = self._nodes[columns]
        x = torch.cat([x[:, :self._split], carried], dim=1)
        keep = self._on[columns][:, :, None]
        old = self._x[columns]
        index = nodes[:, :, None].expand(-1, -1, 3)
        self._x[columns] = old.scatter(1, index, torch.where(keep, x, old.gather(1, index)))
        here, softening = wp.from_torch(self._x, dtype=k.vec3), wp.from_torch(self.softening)
        for side in self._sides:
            self._launch(k.evaluate, side, columns, [
                *side.arrays("facet stiffness faces smooth"), softening, self.stick, here,
                                                     *side.arrays("candidates anchored anchor_face anchor_shape "
                                                                  "limit across"),
                *side.arrays("gap face shape normal push drag way rows slips astray energy")])
        self._contact = None

    def lag(self, columns: torch.Tensor) -> None:
        """Renew friction's limit and tangent plane from what `evaluate` found last."""
        if not self.rubs:
            return
        k = self.kernels
        softening, before, swept = wp.from_torch(self.softening), wp.from_torch(self._x_before,
                                                                                dtype=k.vec3), wp.from_torch(self._x_swept, dtype=k.vec3)
        for side in self._sides:
            self._launch(k.lag, side, columns, [
                *side.arrays("stiffness faces"), softening, self._friction, *side.arrays("candidates"), before, swept,
                *side.arrays("gap face shape normal"),
                                                *side.arrays("anchored anchor_face anchor_shape limit across "
                                                             "anchorings damping change miss")])

    def unlawful(self, columns: torch.Tensor) -> torch.Tensor:
        """By how much friction's limits miss Coulomb's (k,) [N]: what damping has held back of their last change."""
        return sum(side.relaxation.unlawful(columns) for side in self._sides)

    def settle(self, columns: torch.Tensor) -> None:
        """The step is done: let slipping points drag their anchors, and forget those that left."""
        if not self.rubs or not len(columns):
            return
        k = self.kernels
        here = wp.from_torch(self._x, dtype=k.vec3)
        for side in self._sides:
            self._launch(k.settle, side, columns, [
                *side.arrays("stiffness faces"), contact.STICK, here,
                                                   *side.arrays("candidates gap limit across anchored anchor_face "
                                                                "anchor_shape")])

    def memory(self) -> list[dict[str, torch.Tensor]]:
        """Friction's memory, to return to if a step fails; see `restore`."""
        return [{key: value.clone() for key, value in side.memory.items()} for side in self._sides] if self.rubs else []

    def restore(self, columns: torch.Tensor, memory: list[dict[str, torch.Tensor]]) -> None:
        """Set friction's memory of ``columns`` back."""
        for side, kept in zip(self._sides, memory, strict=False):
            for key, value in kept.items():
                side.memory[key][columns] = value[columns]

    # ------------------------------------------------------------------------------------------ results

    def _sum(self, name: str, columns: torch.Tensor) -> torch.Tensor:
        return sum(side.state[name][columns].sum(dim=1) for side in self._sides)

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of the contact (k,) [J]."""
        return self._sum("energy", columns)

    def astray(self, columns: torch.Tensor) -> torch.Tensor:
        """Points (k,) that lie past the middle of the other body: none, in a solution."""
        return self._sum("astray", columns)

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        """Is any point inside the other body? (k,) bool."""
        return torch.stack([(side.state["gap"][columns] < 0.0).any(dim=1) for side in self._sides]).any(dim=0)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """Deepest point (k,) [m]."""
        return torch.stack([-side.state["gap"][columns].amin(dim=1) for side in self._sides]).amax(dim=0).clamp(min=0.0)

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        """Share of the points in contact that slip (k,) [-]; 0 without contact."""
        inside = sum((side.state["gap"][columns] < 0.0).sum(dim=1) for side in self._sides)
        return self._sum("slips", columns) / inside.clamp(min=1)

    def _chosen(self, columns: torch.Tensor, masks: list[torch.Tensor]) -> list[_Chosen]:
        """Of each side the nodes that its mask (k, Q) names; sides without any are left out."""
        out = []
        for side, mask in zip(self._sides, masks, strict=True):
            most = int(mask.sum(dim=1).amax())
            if most:
                on, order = torch.sort(mask.to(torch.int8), dim=1, descending=True, stable=True)
                out.append(_Chosen(side, (columns[:, None], order[:, :most]), on[:, :most].to(torch.float64)))
        return out

    def _links(self, columns: torch.Tensor, chosen: list[_Chosen], places: list[tuple[torch.Tensor, torch.Tensor]],
               directions: list[torch.Tensor]) -> Links | None:
        """Ties of the chosen nodes to ``places`` on the other side, each a face (k, a) and shape values (k, a, 6), with
        ``directions`` (k, a, m, 3) in the world."""
        if not chosen:
            return None
        place = self._place[columns]
        rows = torch.arange(len(columns), device=self.device)[:, None, None]
        width = 1 + max(own.side.faces.shape[2] for own in chosen)
        nodes, weights = [], []
        for own, (face, shape) in zip(chosen, places, strict=True):
            side = own.side
            there = place[rows, side.faces[columns[:, None], face.clamp(min=0).long()].long()]
            node = torch.cat([place.gather(1, side.first + own.at[1])[:, :, None], there], dim=2)
            held = (own.on * (face >= 0))[:, :, None]
            weight = torch.cat([own.on[:, :, None], -shape[:, :, :side.faces.shape[2]] * held], dim=2)
            spare = (0, width - node.shape[2])
            nodes.append(torch.nn.functional.pad(node, spare))
            weights.append(torch.nn.functional.pad(weight, spare))
        world = torch.cat(directions, dim=1)
        return Links.of(self._split, self._nodes.shape[1], torch.cat(nodes, dim=1), torch.cat(weights, dim=1), world,
                        world @ self._turn[columns][:, None])

    def _touching(self, columns: torch.Tensor) -> _Contact:
        """The points in contact, as they were evaluated last."""
        if self._contact is not None and torch.equal(self._contact.columns, columns):
            return self._contact
        push = torch.zeros((len(columns), self.dof.shape[1]), dtype=torch.float64, device=self.device)
        drag = torch.zeros_like(push)
        chosen = self._chosen(columns, [(side.state["gap"][columns] < 0.0) | (side.memory["limit"][columns] > 0.0)
                                        for side in self._sides])
        roots = [own.of("rows") * own.on[:, :, None, None] for own in chosen]
        normal = self._links(columns, chosen, [(own.of("face"), own.of("shape")) for own in chosen],
                             [r[:, :, :1] for r in roots])
        across = None
        if normal is not None:
            push = self._share(columns, normal, torch.cat([own.of("push") * own.on[:, :, None] for own in chosen],
                                                          dim=1))
            if self.rubs:
                across = self._links(columns, chosen, [own.anchor() for own in chosen], [r[:, :, 1:] for r in roots])
                drag = self._share(columns, across, torch.cat([own.of("drag") * own.on[:, :, None] for own in chosen],
                                                              dim=1))
        self._contact = _Contact(columns.clone(), normal, across, push, drag)
        return self._contact

    def _share(self, columns: torch.Tensor, links: Links, force: torch.Tensor) -> torch.Tensor:
        """Nodal forces (k, 3 s) [N] of forces (k, a, 3) [N] of the world at the links."""
        return links.share(force, force @ self._turn[columns])

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces (k, 3 s) [N] on the patches' nodes, in the frames of their unknowns."""
        contact = self._touching(columns)
        return contact.push + contact.drag

    def nodal_world(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces (k, s, 3) [N] on the patches' nodes, world."""
        own = self.nodal(columns).view(len(columns), -1, 3)
        return torch.cat([own[:, :self._split], own[:, self._split:] @ self._turn[columns].mT], dim=1)

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Force on the sensor (k, 1, 3) [N], world."""
        return self.nodal_world(columns)[:, self._split:].sum(dim=1, keepdim=True)

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Moment on the sensor about its origin (k, 1, 3) [N m], world."""
        force = self.nodal_world(columns)[:, self._split:]
        index = self._nodes[columns][:, self._split:, None].expand(-1, -1, 3)
        lever = self._x[columns].gather(1, index) - torch.as_tensor(self._pose[:, None, :3, 3],
                                                                    device=self.device)[columns]
        return torch.linalg.cross(lever, force).sum(dim=1, keepdim=True)

    # ------------------------------------------------------------------------------------------ stiffness

    def stiffness(self, columns: torch.Tensor, bend: torch.Tensor | None = None) -> LinkStiffness:
        """Contact stiffness on the patches; it has no geometric term (``bend`` is ignored)."""
        return LinkStiffness(self._all_links(columns), self.free[columns])

    def block(self, columns: torch.Tensor) -> LinkBlock:
        """The contact of ``columns``, ready to be inverted together with both bodies at rest."""
        links = self._all_links(columns)
        assert links is not None, "who asks for the contact block has seen contact"
        return LinkBlock.of(links, self.compliance, columns, self.free[columns])

    def _all_links(self, columns: torch.Tensor) -> Links | None:
        contact = self._touching(columns)
        return (contact.normal if contact.normal is None or contact.across is None
                else contact.normal.beside(contact.across))

    # ------------------------------------------------------------------------------------------ the condensed problem

    def condensed(self, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
                  tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
        """See `pair_condensed.solve`."""
        return pair_condensed.solve(self, columns, base, pushed, iterations=iterations, tolerance=tolerance)

    def near(self, columns: torch.Tensor, part: float, asked: list[torch.Tensor] | None) -> list[torch.Tensor]:
        """Nodes of both sides (k, Q) bool that are nearer to the other surface than ``part`` of the margin, and those
        ``asked`` before."""
        now = [side.state["gap"][columns] < part * self._margin for side in self._sides]
        return now if asked is None else [a | b for a, b in zip(now, asked, strict=True)]

    def meeting(self, columns: torch.Tensor, asked: list[torch.Tensor]) -> tuple[Links | None, torch.Tensor,
                                                                                 torch.Tensor, torch.Tensor]:
        """The nodes ``asked``, padded to the most: their links along the normals, gaps (k, p) [m], how much they give
        under a force (k, p) [m/N], and whether they touch (k, p) bool. A padded one is far off."""
        chosen = self._chosen(columns, asked)
        if not chosen:
            none = torch.zeros((len(columns), 0), dtype=torch.float64, device=self.device)
            return None, none, none, none > 0.0
        links = self._links(columns, chosen, [(own.of("face"), own.of("shape")) for own in chosen],
                            [own.of("normal")[:, :, None] for own in chosen])
        on = torch.cat([own.on for own in chosen], dim=1) > 0.0
        gap = torch.cat([own.of("gap") for own in chosen], dim=1)
        stiffness = self.softening[columns][:, None] * torch.cat([own.stiffness() for own in chosen], dim=1)
        return links, torch.where(on, gap, 1.0), torch.where(on, 1.0 / stiffness.clamp(min=1e-12),
                                                             1.0), on & (gap < 0.0)

    def tangential(self, columns: torch.Tensor, *, stuck: bool) -> tuple[torch.Tensor, Links | None]:
        """Friction's forces (k, 3 s) [N] on the patches, and the links whose rows [sqrt(N/m)] make its stiffness (none
        without friction).

        ``stuck``: as if every point that friction holds stuck, however far it is from its anchor.
        """
        if not stuck or not self.rubs:
            contact = self._touching(columns)
            return contact.drag, contact.across
        chosen = self._chosen(columns, [side.memory["limit"][columns] > 0.0 for side in self._sides])
        if not chosen:
            return torch.zeros((len(columns), self.dof.shape[1]), dtype=torch.float64, device=self.device), None
        stiffness = self.stick * self.softening[columns][:, None] * torch.cat([own.stiffness() * own.on
                                                                               for own in chosen], dim=1)
        normal = torch.cat([own.side.memory["across"][own.at] for own in chosen], dim=1)
        axis = torch.nn.functional.one_hot(normal.abs().argmin(dim=2), 3).to(normal.dtype)
        first = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=2)
        directions = torch.stack([first, torch.linalg.cross(normal, first)], dim=2) * stiffness.sqrt()[:, :, None, None]
        links = self._links(columns, chosen, [own.anchor() for own in chosen], [directions])
        return self._share(columns, links, -stiffness[:, :, None] * torch.cat([own.of("way") for own in chosen],
                                                                              dim=1)), links

    # ------------------------------------------------------------------------------------------ between steps

    def remember(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces of ``columns`` (all of them) as the next step can read them: (3 N, B) [N]."""
        size = 3 * (self._count + len(self.sensor.mesh.points))
        out = torch.zeros((size, len(columns)), dtype=torch.float64, device=self.device)
        return out.scatter_add_(0, self._index.T, self.nodal(columns).T)

    def recall(self, remembered: torch.Tensor) -> torch.Tensor:
        """Remembered forces (B, 3 s) [N] on the present patches."""
        return remembered.gather(0, self._index.T).T * self.real

    def nothing(self) -> torch.Tensor:
        """Remembered forces of a touch that has none."""
        return torch.zeros((3 * (self._count + len(self.sensor.mesh.points)), self.batch), dtype=torch.float64,
                           device=self.device)

    def foresee(self, columns: torch.Tensor, u: torch.Tensor) -> None:
        """Look up who may meet whom anew, with normals as they are at the predicted displacements u (3 N, B)."""
        self._x[columns] = self._positions(u, self._pose)[columns]
        self._look_up(self._margin, columns, blend=columns)

    def grow(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> bool:
        """Look up who may meet whom anew, from where the surfaces are now; True if that finds contact that was not
        seen, or normals that have turned."""
        seen = [side.state["gap"][columns].clamp(max=0.0) for side in self._sides]
        self._x[columns] = self._positions(u, self._pose)[columns]
        turned = columns[(self._turned() & ~self._blended)[columns]]
        self._blended[turned] = True  # once in a step: more would chase the last digit
        self._look_up(self._margin, columns, blend=turned)
        self.evaluate(columns, self.gather(u)[columns])
        return len(turned) > 0 or any(bool(((old - side.state["gap"][columns].clamp(max=0.0)).abs() > _FOUND).any())
                                      for side, old in zip(self._sides, seen, strict=True))

    def _turned(self) -> torch.Tensor:
        """Whose normals have turned where they touch since they were blended (B,) bool."""
        out = torch.zeros(self.batch, dtype=torch.bool, device=self.device)
        for side in self._sides:
            at, node = (side.state["gap"] < 0.0).nonzero(as_tuple=True)
            face = side.state["face"][at, node].long()
            far = (self._blend(side)[at, face] - side.smooth[at, face]).norm(dim=2).amax(dim=1) > _TURNED
            out[at[far]] = True
        return out
