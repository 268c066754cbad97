"""Links between the points in contact of two surfaces, as sparse rows over the displacements of the patches.

A link is a point of one surface and its place on the other, with one or more directions; J v is the relative
displacement along each. Where forces act along other directions than the one along which a displacement counts, J^T is
short for the rows of the forces. A row depends on a few nodes of the patch. A is the compliance of both bodies at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from vsfsim.physics.contact.pair import rows

_OF_EACH = ("node", "weight", "world", "own", "slope_world", "slope_own", "table")  # tensors of `Links`


@dataclass(frozen=True)
class Compliance:
    """Compliance of both bodies at rest on the patches of B touches; 0 where held or padded."""

    on_object: torch.Tensor
    """Of the o object nodes in the patch, world (B, 3 o, 3 o) [m/N]."""
    on_sensor: torch.Tensor
    """Of the c sensor nodes, in the sensor's frame (B, 3 c, 3 c) [m/N]."""

    def respond(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Displacements (k, 3 s) [m] of the patches of ``columns`` (k,) under forces (k, 3 s) [N] on them."""
        split = self.on_object.shape[1]
        return torch.cat([times(some(self.on_object, columns), force[:, :split]),
                          times(some(self.on_sensor, columns), force[:, split:])], dim=1)


@dataclass(frozen=True)
class Links:
    """Links of k touches, a each, with m directions; padding has weight 0."""

    split: int
    """First patch node of the sensor; the object's come before it."""
    node: torch.Tensor
    """Patch nodes that each link depends on (k, a, n), int32."""
    weight: torch.Tensor
    """Their weights (k, a, n) [-]."""
    world: torch.Tensor
    """Directions in the world, times any factor of the rows (k, a, m, 3)."""
    own: torch.Tensor
    """The same directions in the sensor's frame (k, a, m, 3)."""
    slope_world: torch.Tensor
    """Directions along which a displacement counts, in the world (k, a, m, 3); forces act along `world`."""
    slope_own: torch.Tensor
    """The same in the sensor's frame (k, a, m, 3)."""
    table: torch.Tensor
    """The weights of all patch nodes (k, a, s) [-]."""

    @classmethod
    def of(cls, split: int, count: int, node: torch.Tensor, weight: torch.Tensor, world: torch.Tensor,
           own: torch.Tensor, slope_world: torch.Tensor, slope_own: torch.Tensor) -> Links:
        """Links on a patch with ``count`` nodes; the nodes of a link that have a weight must differ."""
        table = torch.zeros((*node.shape[:2], count), dtype=torch.float64, device=node.device)
        table.scatter_add_(2, node, weight)  # padding adds 0
        return cls(split, node.to(torch.int32), weight, world, own, slope_world, slope_own, table)

    def pick(self, which: torch.Tensor) -> Links:
        """Those of some of the touches (j,)."""
        return Links(self.split, *(some(getattr(self, name), which) for name in _OF_EACH))

    def beside(self, other: Links) -> Links:
        """These links and others of the same patches, each direction as a link of its own."""
        one, two = self._single(), other._single()
        return Links(self.split, *(torch.cat([getattr(one, name), getattr(two, name)], dim=1) for name in _OF_EACH))

    def _single(self) -> Links:
        m = self.world.shape[2]
        if m == 1:
            return self
        node, weight, table = (getattr(self, name).repeat_interleave(m, dim=1) for name in ("node", "weight", "table"))
        return Links(self.split, node, weight, *(d.flatten(1, 2)[:, :, None] for d in (
            self.world, self.own, self.slope_world, self.slope_own)), table)

    def jump(self, v: torch.Tensor) -> torch.Tensor:
        """J v (k, a m) for displacements v (k, 3 s)."""
        x, split = v.view(len(v), -1, 3), self.split
        world, own = self.table[:, :, :split] @ x[:, :split], self.table[:, :, split:] @ x[:, split:]
        return ((self.slope_world * world[:, :, None]).sum(dim=3)
                + (self.slope_own * own[:, :, None]).sum(dim=3)).flatten(1)

    def push(self, force: torch.Tensor) -> torch.Tensor:
        """J^T f (k, 3 s) for f (k, a m)."""
        f = force.view(*self.world.shape[:3], 1)
        return self.share((f * self.world).sum(dim=2), (f * self.own).sum(dim=2))

    def share(self, world: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        """Nodal forces (k, 3 s) of a force at every link, given in both frames (k, a, 3)."""
        return torch.cat([self.table[:, :, :self.split].mT @ world, self.table[:, :, self.split:].mT @ own],
                         dim=1).flatten(1)

    def _arrays(self, world: torch.Tensor, own: torch.Tensor) -> list[wp.array]:
        vec3 = rows.kernels().vec3
        return [wp.from_torch(self.node.contiguous()), wp.from_torch(self.weight.contiguous()),
                wp.from_torch(world.contiguous(), dtype=vec3), wp.from_torch(own.contiguous(), dtype=vec3)]

    def responses(self, compliance: Compliance, columns: torch.Tensor) -> torch.Tensor:
        """J A (k, a m, s, 3) [m/N]: displacements of the patches of ``columns`` (k,) under a unit force along each
        row."""
        kernels, (k, a, m, _), s = rows.kernels(), self.world.shape, self.table.shape[2]
        out = torch.empty((k, a * m, s, 3), dtype=torch.float64, device=self.node.device)
        wp.launch(kernels.responses, dim=(k, a * m, s), device=str(out.device), inputs=[
            wp.from_torch(columns.to(torch.int32)), self.split, wp.from_torch(compliance.on_object),
            wp.from_torch(compliance.on_sensor), *self._arrays(self.world, self.own),
            wp.from_torch(out, dtype=kernels.vec3)])
        return out

    def gram(self, x: torch.Tensor) -> torch.Tensor:
        """J X^T (k, a m, r) for rows X (k, r, s, 3)."""
        kernels, (k, a, m, _) = rows.kernels(), self.world.shape
        out = torch.empty((k, a * m, x.shape[1]), dtype=torch.float64, device=self.node.device)
        wp.launch(kernels.gram, dim=(k, x.shape[1], a), device=str(out.device), inputs=[
            self.split, *self._arrays(self.slope_world, self.slope_own), wp.from_torch(x, dtype=kernels.vec3),
            wp.from_torch(out)])
        return out


def some(table: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
    """Entries ``which`` (k,), in rising order, of the first axis; no copy if that is all of them."""
    return table if len(which) == len(table) else table[which]


def times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """Products (k, p) of matrices (k, p, q) and vectors (k, q)."""
    return (matrix @ vector[:, :, None])[:, :, 0]


@dataclass(frozen=True)
class LinkStiffness:
    """The contact stiffness J^T J (directions carry the roots) as an operator: ``stiffness @ v`` for v (k, 3 s, 1)."""

    links: Links | None
    free: torch.Tensor

    def __getitem__(self, which: torch.Tensor) -> LinkStiffness:
        return LinkStiffness(None if self.links is None else self.links.pick(which), self.free[which])

    def __setitem__(self, which: torch.Tensor, other: LinkStiffness) -> None:
        """The stiffness of a pair has no part that a retry would leave out: it is the same."""

    def __matmul__(self, v: torch.Tensor) -> torch.Tensor:
        if self.links is None:
            return torch.zeros_like(v)
        return (self.links.push(self.links.jump(v[:, :, 0] * self.free)) * self.free)[:, :, None]


@dataclass(frozen=True)
class LinkBlock:
    """As `ContactBlock`: ``apply`` returns T v with T = J^T (1 + J A J^T)^-1 J."""

    links: Links
    inner: torch.Tensor
    """LU factors of 1 + J A J^T (k, r, r)."""
    pivots: torch.Tensor
    """Their pivots (k, r)."""
    free: torch.Tensor
    """1 where the patches may move (k, 3 s) [-]."""

    @classmethod
    def of(cls, links: Links, compliance: Compliance, columns: torch.Tensor, free: torch.Tensor) -> LinkBlock:
        """From links whose directions carry the roots of the stiffness [sqrt(N/m)], for the touches ``columns``
        (k,)."""
        inner = links.gram(links.responses(compliance, columns))
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(links, *torch.linalg.lu_factor(inner), free)

    def pick(self, which: torch.Tensor) -> LinkBlock:
        """That of some of the touches (j,)."""
        return LinkBlock(self.links.pick(which), some(self.inner, which), some(self.pivots, which), self.free[which])

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        inside = torch.linalg.lu_solve(self.inner, self.pivots, self.links.jump(v * self.free)[:, :, None])[:, :, 0]
        return self.links.push(inside) * self.free
