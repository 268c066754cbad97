"""Links between the points in contact of two surfaces, as sparse rows over the displacements of their nodes.

A link is a point of one surface and its place on the other. A row J is a direction of a link: J v is the relative
displacement along it. Where forces act along other directions than the one along which a displacement counts, J^T is
short for the rows of the forces. A row depends on a few nodes. A is the compliance of both bodies at rest.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch


@dataclass(frozen=True)
class Links:
    """Rows of k touches, r each; padding has weight 0."""

    count: int
    """Surface nodes of a touch s."""
    node: torch.Tensor
    """Nodes that each row depends on (k, r, n); those that have a weight differ."""
    force: torch.Tensor
    """Forces on these nodes under a unit force along the row (k, r, n, 3), the object's in the world, the sensor's in
    its frame, times any factor of the row."""
    slope: torch.Tensor
    """How the displacements of these nodes count (k, r, n, 3), likewise."""

    @classmethod
    def of(cls, split: int, count: int, node: torch.Tensor, weight: torch.Tensor, turn: torch.Tensor,
           world: torch.Tensor, slope: torch.Tensor | None = None) -> Links:
        """The m rows of each of a links of k touches.

        Args:
            split: first node of the sensor; the object's come before it.
            count: see the fields.
            node, weight: nodes of each link (k, a, n) and their weights [-].
            turn: rotations of the sensor (k, 3, 3).
            world: directions in the world (k, a, m, 3).
            slope: those along which a displacement counts, likewise; None for the same.
        """
        each, on_sensor = world.shape[2], (node >= split)[:, :, None, :, None]

        def spread(direction: torch.Tensor) -> torch.Tensor:
            own = torch.where(on_sensor, (direction @ turn[:, None])[:, :, :, None], direction[:, :, :, None])
            return (weight[:, :, None, :, None] * own).flatten(1, 2)

        force = spread(world)
        return cls(count, node.repeat_interleave(each, dim=1), force, force if slope is None else spread(slope))

    def pick(self, which: torch.Tensor) -> Links:
        """Those of some of the touches (j,)."""
        return Links(self.count, self.node[which], self.force[which], self.slope[which])

    def beside(self, other: Links) -> Links:
        """These rows and others of the same touches."""
        return Links(self.count, *(torch.cat(both, dim=1) for both in (
            (self.node, other.node), (self.force, other.force), (self.slope, other.slope))))

    def jump(self, v: torch.Tensor) -> torch.Tensor:
        """J v (k, r) for displacements v (k, 3 s)."""
        return torch.sparse.mm(self._counts, v.reshape(-1, 1)).view(self.node.shape[:2])

    def push(self, force: torch.Tensor) -> torch.Tensor:
        """J^T f (k, 3 s) for f (k, r)."""
        return torch.sparse.mm(self._pushes.t(), force.reshape(-1, 1)).view(len(force), 3 * self.count)

    def gram(self, between: Callable[[torch.Tensor], torch.Tensor]) -> torch.Tensor:
        """J A J^T (k, r, r); ``between``: the compliance (k, 3 m, 3 m) [m/N] between some nodes (k, m)."""
        on = (self.force != 0.0).any(dim=3)
        used = torch.zeros((len(on), self.count), dtype=torch.int32, device=on.device)
        used.scatter_reduce_(1, self.node.flatten(1), on.flatten(1).to(torch.int32), "amax")
        at = torch.sort(used, dim=1, descending=True, stable=True)[1][:, :int(used.sum(dim=1).amax())]
        place = torch.zeros(used.shape, dtype=torch.int64, device=on.device)
        place.scatter_(1, at, torch.arange(at.shape[1], device=on.device).expand_as(at).contiguous())
        few = replace(self, count=at.shape[1], node=place.gather(1, self.node.flatten(1)).view_as(self.node))
        rows = torch.sparse.mm(few._pushes, between(at).flatten(0, 1)).view(*on.shape[:2], -1)
        return torch.sparse.mm(few._counts, rows.mT.flatten(0, 1)).view(*on.shape[:2], -1)

    @functools.cached_property
    def _pushes(self) -> torch.Tensor:
        return self._rows(self.force)

    @functools.cached_property
    def _counts(self) -> torch.Tensor:
        return self._rows(self.slope)

    def _rows(self, values: torch.Tensor) -> torch.Tensor:
        """The rows of all touches, a block diagonal matrix (k r, 3 k s)."""
        (k, r, _), width, three = self.node.shape, 3 * self.count, torch.arange(3, device=values.device)
        touch, row, at = (values != 0.0).any(dim=3).nonzero(as_tuple=True)
        column = (touch * width + 3 * self.node[touch, row, at])[:, None] + three
        index = torch.stack([(touch * r + row)[:, None].expand(-1, 3), column]).flatten(1)
        return torch.sparse_coo_tensor(index, values[touch, row, at].flatten(), (k * r, k * width),
                                       check_invariants=False)


@dataclass(frozen=True)
class LinkStiffness:
    """The contact stiffness J^T J (directions carry the roots) as an operator: ``stiffness @ v`` for v (k, 3 s, 1)."""

    links: Links | None
    free: torch.Tensor

    def __getitem__(self, which: torch.Tensor) -> LinkStiffness:
        return LinkStiffness(None if self.links is None else self.links.pick(which), self.free[which])

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
    """1 where the nodes may move (k, 3 s) [-]."""

    @classmethod
    def of(cls, links: Links, between: Callable[[torch.Tensor], torch.Tensor], free: torch.Tensor) -> LinkBlock:
        """From links whose directions carry the roots of the stiffness [sqrt(N/m)]; ``between``: see `Links.gram`."""
        inner = links.gram(between)
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(links, *torch.linalg.lu_factor(inner), free)

    def pick(self, which: torch.Tensor) -> LinkBlock:
        """That of some of the touches (j,)."""
        return LinkBlock(self.links.pick(which), self.inner[which], self.pivots[which], self.free[which])

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        inside = torch.linalg.lu_solve(self.inner, self.pivots, self.links.jump(v * self.free)[:, :, None])[:, :, 0]
        return self.links.push(inside) * self.free
