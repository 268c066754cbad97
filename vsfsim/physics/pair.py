"""Contact of a batch of touches between an object and the deformable surface of a sensor that is carried along.

The counterpart of `touching` for two deformable bodies, with the same interface, so that the same solver works on it. The unknowns are the
displacements of the object's nodes in the world and, after them, those of the sensor's nodes in the sensor's own frame: there its
elements and its rest-state factor do not change while it is carried along.

A step knows, for every point, the faces of the other surface that it may meet (`search`); the nodes of these are the *patch* of the step. It is
small, and another one in every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics import contact, pair_condensed
from vsfsim.physics.pair_links import LinkBlock, Links, LinkStiffness
from vsfsim.physics.pair_surfaces import PairSurfaces, Side

_FOUND = 1e-9  # m: a gap that changes by more when the faces are looked up anew was wrong


@dataclass(frozen=True)
class _Contact:
    """The points in contact of the touches ``columns`` (k,): links along the normals and across them, whose rows carry the roots of the stiffness,
    and the nodal forces of both (k, 3 s) [N]."""

    columns: torch.Tensor
    normal: list[Links]
    across: list[Links]
    push: torch.Tensor
    drag: torch.Tensor


class PairTouching(PairSurfaces):
    """Contact state of B touches of an object by a sensor's surface.

    The attributes dof, free, real, rest, compliance and response are those of the present step's patch; see `Touching` for them and for the
    methods that have the same names.

    Args:
        model: the object. sensor: the body with the touching surface, in its own frame (free displacements there).
        friction: Coulomb's coefficient of the pair [-]. poses: sensor to world (T, B, 4, 4), to find what is in reach. device: Warp device.
        stride: longest way of the sensor in a step [m].
    """

    # ------------------------------------------------------------------------------------------ evaluation

    def gather(self, u: torch.Tensor) -> torch.Tensor:
        """Displacements (B, 3 s) [m] of the patches out of u (3 N, B), the sensor's in its frame."""
        return u.gather(0, self._index.T).T.to(torch.float64) * self.real

    def _common(self, side: Side, columns: torch.Tensor) -> list[Any]:
        return [side.faces.shape[2], wp.from_torch(columns.to(torch.int32)), side.first]

    def _anchors(self, side: Side) -> list[Any]:
        k, m = self.kernels, side.memory
        return [wp.from_torch(m["anchored"]), wp.from_torch(m["face"]), wp.from_torch(m["shape"], dtype=k.vec6)]

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Gaps, forces and stiffness of the touches ``columns`` (k,) for displacements (k, 3 s) [m] of their patches."""
        k = self.kernels
        x = (self.rest[columns] + displacement).view(len(columns), -1, 3)
        carried = x[:, self._split:] @ self._turn[columns].mT + torch.as_tensor(self._pose[:, None, :3, 3], device=self.device)[columns]
        nodes = self._nodes[columns]
        x = torch.cat([x[:, :self._split], carried], dim=1)
        keep = self._on[columns][:, :, None]
        old = self._x[columns]
        index = nodes[:, :, None].expand(-1, -1, 3)
        self._x[columns] = old.scatter(1, index, torch.where(keep, x, old.gather(1, index)))
        for side in self._sides:
            s, m, size = side.state, side.memory, side.stiffness.shape
            wp.launch(k.evaluate, dim=(size[1], len(columns)), device=self.device, inputs=[
                *self._common(side, columns), wp.from_torch(side.facet), wp.from_torch(side.stiffness), wp.from_torch(side.faces),
                wp.from_torch(side.smooth, dtype=k.vec3), wp.from_torch(self.softening), self.stick, wp.from_torch(self._x, dtype=k.vec3), wp.from_torch(side.candidates), *self._anchors(side),
                wp.from_torch(m["limit"]), wp.from_torch(m["across"], dtype=k.vec3),
                wp.from_torch(s["gap"]), wp.from_torch(s["face"]), wp.from_torch(s["shape"], dtype=k.vec6), wp.from_torch(s["normal"], dtype=k.vec3),
                wp.from_torch(s["push"], dtype=k.vec3), wp.from_torch(s["drag"], dtype=k.vec3), wp.from_torch(s["way"], dtype=k.vec3), wp.from_torch(s["rows"], dtype=k.mat33),
                wp.from_torch(s["slips"]), wp.from_torch(s["astray"]), wp.from_torch(s["energy"])])
        self._contact = None

    def lag(self, columns: torch.Tensor) -> None:
        """Renew friction's limit and tangent plane from what `evaluate` found last."""
        if not self.rubs:
            return
        k = self.kernels
        for side in self._sides:
            s, m, size = side.state, side.memory, side.stiffness.shape
            wp.launch(k.lag, dim=(size[1], len(columns)), device=self.device, inputs=[
                *self._common(side, columns), wp.from_torch(side.stiffness), wp.from_torch(side.faces), wp.from_torch(self.softening), self._friction,
                wp.from_torch(side.candidates), wp.from_torch(self._x_before, dtype=k.vec3), wp.from_torch(self._x_swept, dtype=k.vec3),
                wp.from_torch(s["gap"]), wp.from_torch(s["face"]), wp.from_torch(s["shape"], dtype=k.vec6), wp.from_torch(s["normal"], dtype=k.vec3),
                *self._anchors(side), wp.from_torch(m["limit"]), wp.from_torch(m["across"], dtype=k.vec3)])

    def settle(self, columns: torch.Tensor) -> None:
        """The step is done: let slipping points drag their anchors, and forget those that left."""
        if not self.rubs or not len(columns):
            return
        k = self.kernels
        for side in self._sides:
            s, m, size = side.state, side.memory, side.stiffness.shape
            wp.launch(k.settle, dim=(size[1], len(columns)), device=self.device, inputs=[
                *self._common(side, columns), wp.from_torch(side.stiffness), wp.from_torch(side.faces), contact.STICK, wp.from_torch(self._x, dtype=k.vec3),
                wp.from_torch(side.candidates), wp.from_torch(s["gap"]), wp.from_torch(m["limit"]), wp.from_torch(m["across"], dtype=k.vec3),
                *self._anchors(side)])

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

    def _chosen(self, side: Side, columns: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Nodes of a side (k, a) that ``mask`` (k, Q) names, padded to the most, and 1 where they are not padded (k, a)."""
        most = int(mask.sum(dim=1).amax())
        if most == 0:
            return None
        on, order = torch.sort(mask.to(torch.int8), dim=1, descending=True, stable=True)
        return order[:, :most], on[:, :most].to(torch.float64)

    def _links(self, side: Side, columns: torch.Tensor, order: torch.Tensor, on: torch.Tensor, face: torch.Tensor, shape: torch.Tensor,
               directions: torch.Tensor) -> Links:
        """The nodes ``order`` (k, a) of a side, tied to the places ``shape`` (k, a, 6) on the ``face`` (k, a) of the other side, with
        ``directions`` (k, a, m, 3) in the world; ``on`` (k, a): 0 for padded ones."""
        split, count = self._split, self._nodes.shape[1]
        place = self._place[columns]
        rows = torch.arange(len(columns), device=self.device)[:, None, None]
        own = place.gather(1, side.first + order)[:, :, None]
        other = place[rows, side.faces[columns[:, None], face.clamp(min=0).long()].long()]
        across = -shape[:, :, :side.faces.shape[2]] * (on * (face >= 0))[:, :, None]
        one = on[:, :, None]
        (at, weight), (node, held) = ((other, across), (own, one)) if side.first else ((own, one), (other, across))
        table = torch.zeros((*order.shape, max(split, 1)), dtype=torch.float64, device=self.device)
        table.scatter_add_(2, at.clamp(max=split - 1), weight)
        return Links(table, (node - split).clamp(0, count - split - 1), held, directions, directions @ self._turn[columns][:, None])

    def _touching(self, columns: torch.Tensor) -> _Contact:
        """The points in contact, as they were evaluated last."""
        if self._contact is not None and torch.equal(self._contact.columns, columns):
            return self._contact
        normal, across = [], []
        force = torch.zeros((len(columns), self.dof.shape[1]), dtype=torch.float64, device=self.device)
        drag = torch.zeros_like(force)
        turn = self._turn[columns]
        for side in self._sides:
            active = (side.state["gap"][columns] < 0.0) | (side.memory["limit"][columns] > 0.0)
            chosen = self._chosen(side, columns, active)
            if chosen is None:
                continue
            order, on = chosen
            at = (columns[:, None], order)
            state, memory = side.state, side.memory
            roots = state["rows"][at] * on[:, :, None, None]
            normal.append(self._links(side, columns, order, on, state["face"][at], state["shape"][at], roots[:, :, :1]))
            push = state["push"][at] * on[:, :, None]
            force += normal[-1].share(push, push @ turn, force.shape[1])
            if self.rubs:
                across.append(self._links(side, columns, order, on, memory["face"][at], memory["shape"][at], roots[:, :, 1:]))
                pull = state["drag"][at] * on[:, :, None]
                drag += across[-1].share(pull, pull @ turn, force.shape[1])
        self._contact = _Contact(columns.clone(), normal, across, force, drag)
        return self._contact

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
        lever = self._x[columns].gather(1, index) - torch.as_tensor(self._pose[:, None, :3, 3], device=self.device)[columns]
        return torch.linalg.cross(lever, force).sum(dim=1, keepdim=True)

    # ------------------------------------------------------------------------------------------ stiffness

    def stiffness(self, columns: torch.Tensor, bend: torch.Tensor | None = None) -> LinkStiffness:
        """Contact stiffness on the patches; it has no geometric term (``bend`` is ignored)."""
        contact = self._touching(columns)
        return LinkStiffness([*contact.normal, *contact.across], self.free[columns])

    def block(self, columns: torch.Tensor) -> LinkBlock:
        """The contact of ``columns``, ready to be inverted together with both bodies at rest."""
        contact = self._touching(columns)
        return LinkBlock.of([*contact.normal, *contact.across], self.compliance.pick(columns))

    # ------------------------------------------------------------------------------------------ the condensed problem

    def condensed(self, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
                  tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
        """See `pair_condensed.solve`."""
        return pair_condensed.solve(self, columns, base, pushed, iterations=iterations, tolerance=tolerance)

    def near(self, columns: torch.Tensor, part: float, asked: list[torch.Tensor] | None) -> list[torch.Tensor]:
        """Nodes of both sides (k, Q) bool that are nearer to the other surface than ``part`` of the margin, and those ``asked`` before."""
        now = [side.state["gap"][columns] < part * self._margin for side in self._sides]
        return now if asked is None else [a | b for a, b in zip(now, asked, strict=True)]

    def meeting(self, columns: torch.Tensor, asked: list[torch.Tensor]) -> tuple[list[Links], torch.Tensor, torch.Tensor, torch.Tensor]:
        """The nodes ``asked``, padded to the most: their links along the normals, gaps (k, p) [m], how much they give under a force (k, p) [m/N],
        and whether they touch (k, p) bool. A padded one is far off."""
        links, gaps, gives, held = [], [], [], []
        for side, mask in zip(self._sides, asked, strict=True):
            chosen = self._chosen(side, columns, mask)
            if chosen is None:
                continue
            order, on = chosen
            at = (columns[:, None], order)
            state = side.state
            links.append(self._links(side, columns, order, on, state["face"][at], state["shape"][at], state["normal"][at][:, :, None]))
            give = 1.0 / (self.softening[columns][:, None] * side.stiffness[at]).clamp(min=1e-12)
            gaps.append(torch.where(on > 0.0, state["gap"][at], 1.0))
            gives.append(torch.where(on > 0.0, give, 1.0))
            held.append((on > 0.0) & (state["gap"][at] < 0.0))
        return links, *(torch.cat(p, dim=1) if p else torch.zeros((len(columns), 0), device=self.device) for p in (gaps, gives, held))

    def tangential(self, columns: torch.Tensor, *, stuck: bool) -> tuple[torch.Tensor, list[Links]]:
        """Friction's forces (k, 3 s) [N] on the patches, and the links whose rows [sqrt(N/m)] make its stiffness (none without friction).

        ``stuck``: as if every point that friction holds stuck, however far it is from its anchor.
        """
        contact = self._touching(columns)
        if not stuck or not self.rubs:
            return contact.drag, contact.across
        turn = self._turn[columns]
        force, links = torch.zeros_like(contact.drag), []
        for side in self._sides:
            chosen = self._chosen(side, columns, side.memory["limit"][columns] > 0.0)
            if chosen is None:
                continue
            order, on = chosen
            at = (columns[:, None], order)
            memory = side.memory
            stiffness = self.stick * self.softening[columns][:, None] * side.stiffness[at] * on
            normal = memory["across"][at]
            axis = torch.nn.functional.one_hot(normal.abs().argmin(dim=2), 3).to(normal.dtype)
            first = torch.nn.functional.normalize(torch.linalg.cross(normal, axis), dim=2)
            directions = torch.stack([first, torch.linalg.cross(normal, first)], dim=2) * stiffness.sqrt()[:, :, None, None]
            links.append(self._links(side, columns, order, on, memory["face"][at], memory["shape"][at], directions))
            pull = -stiffness[:, :, None] * side.state["way"][at]
            force += links[-1].share(pull, pull @ turn, force.shape[1])
        return force, links

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
        return torch.zeros((3 * (self._count + len(self.sensor.mesh.points)), self.batch), dtype=torch.float64, device=self.device)

    def grow(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> bool:
        """Look up who may meet whom anew, from where the surfaces are now; True if that finds contact which was not seen."""
        seen = [(side.candidates.clone(), side.state["gap"].clone()) for side in self._sides]
        self._x.copy_(self._positions(u, self._pose))
        # normals are blended twice in a step: as it began, and once more where it first came to rest
        changed = not self._blended and bool(self.touches(columns).any())
        self._look_up(self._margin, blend=changed)
        self._blended = True
        self.evaluate(columns, self.gather(u)[columns])
        for side, (_, gap) in zip(self._sides, seen, strict=True):
            old, new = gap[columns].clamp(max=0.0), side.state["gap"][columns].clamp(max=0.0)
            changed = changed or bool(((old - new).abs() > _FOUND).any())
        return changed
