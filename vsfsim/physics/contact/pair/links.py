"""Links between the points in contact of two surfaces, as sparse rows over the displacements of the patches.

A link is a point of one surface and its place on the other. A row J is a direction of a link: J v is the relative
displacement along it. Where forces act along other directions than the one along which a displacement counts, J^T is
short for the rows of the forces. A row depends on a few nodes of the patch, so that products with compliances cost
(rows x patch x nodes of a row). A is the compliance of both bodies at rest.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import torch


@dataclass(frozen=True)
class Compliance:
    """Compliance of both bodies at rest on the patches of B touches; 0 where held or padded."""

    on_object: torch.Tensor
    """Of the o object nodes in the patch, world (B, 3 o, 3 o) [m/N]."""
    on_sensor: torch.Tensor
    """Of the c sensor nodes, in the sensor's frame (B, 3 c, 3 c) [m/N]."""


@dataclass(frozen=True)
class Links:
    """Rows of k touches, r each; padding has weight 0."""

    split: int
    """First patch node of the sensor; the object's come before it."""
    count: int
    """Nodes of a patch s."""
    node: torch.Tensor
    """Patch nodes that each row depends on (k, r, n); those that have a weight differ."""
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
            split, count: see the fields.
            node, weight: patch nodes of each link (k, a, n) and their weights [-].
            turn: rotations of the sensor (k, 3, 3).
            world: directions in the world (k, a, m, 3).
            slope: those along which a displacement counts, likewise; None for the same.
        """
        each, on_sensor = world.shape[2], (node >= split)[:, :, None, :, None]

        def spread(direction: torch.Tensor) -> torch.Tensor:
            own = torch.where(on_sensor, (direction @ turn[:, None])[:, :, :, None], direction[:, :, :, None])
            return (weight[:, :, None, :, None] * own).flatten(1, 2)

        force = spread(world)
        return cls(split, count, node.repeat_interleave(each, dim=1), force, force if slope is None else spread(slope))

    def pick(self, which: torch.Tensor) -> Links:
        """Those of some of the touches (j,)."""
        return replace(self, **{name: some(getattr(self, name), which) for name in ("node", "force", "slope")})

    def beside(self, other: Links) -> Links:
        """These rows and others of the same patches."""
        return replace(self, **{name: torch.cat([getattr(self, name), getattr(other, name)], dim=1)
                                for name in ("node", "force", "slope")})

    def jump(self, v: torch.Tensor) -> torch.Tensor:
        """J v (k, r) for displacements v (k, 3 s)."""
        return torch.sparse.mm(self._counts, v.reshape(-1, 1)).view(self.node.shape[:2])

    def push(self, force: torch.Tensor) -> torch.Tensor:
        """J^T f (k, 3 s) for f (k, r)."""
        return torch.sparse.mm(self._pushes.t(), force.reshape(-1, 1)).view(len(force), 3 * self.count)

    def responses(self, compliance: Compliance, columns: torch.Tensor) -> torch.Tensor:
        """J A (k, r, 3 s) [m/N]: displacements of the patches of ``columns`` (k,) under a unit force along each row."""
        bodies = (0, self.split, compliance.on_object), (self.split, self.count, compliance.on_sensor)
        return torch.cat([torch.sparse.mm(self._rows(self.force, first, end), some(own, columns).flatten(0, 1)).view(
            *self.node.shape[:2], 3 * (end - first)) for first, end, own in bodies], dim=2)

    def gram(self, x: torch.Tensor) -> torch.Tensor:
        """J X^T (k, r, q) for rows X (k, q, 3 s)."""
        return torch.sparse.mm(self._counts, x.mT.flatten(0, 1)).view(*self.node.shape[:2], x.shape[1])

    @functools.cached_property
    def _pushes(self) -> torch.Tensor:
        return self._rows(self.force, 0, self.count)

    @functools.cached_property
    def _counts(self) -> torch.Tensor:
        return self._rows(self.slope, 0, self.count)

    def _rows(self, values: torch.Tensor, first: int, end: int) -> torch.Tensor:
        """The rows of all touches on the nodes from ``first`` to ``end`` of their patches, a block diagonal matrix
        (k r, 3 k (end - first))."""
        (k, r, _), width, three = self.node.shape, 3 * (end - first), torch.arange(3, device=values.device)
        touch, row, at = ((self.node >= first) & (self.node < end) & (values != 0.0).any(dim=3)).nonzero(as_tuple=True)
        column = (touch * width + 3 * (self.node[touch, row, at] - first))[:, None] + three
        index = torch.stack([(touch * r + row)[:, None].expand(-1, 3), column]).flatten(1)
        return torch.sparse_coo_tensor(index, values[touch, row, at].flatten(), (k * r, k * width),
                                       check_invariants=False)


def some(table: torch.Tensor, which: torch.Tensor) -> torch.Tensor:
    """Entries ``which`` (k,), in rising order, of the first axis; no copy if that is all of them."""
    return table if len(which) == len(table) else table[which]


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
