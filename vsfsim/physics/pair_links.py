"""What ties the points in contact of two surfaces to the patches' displacements, never as a dense matrix on the sensor's side.

A link is a point of one surface and its place on the other, with one or more directions: row J of the relative displacement along each. The object's
nodes in a patch are few, so their shape values are a dense table; of the sensor a link knows the one or three nodes that it holds on to.
The compliance of both bodies at rest is A; every product with it costs (links x patch), not (patch x patch).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Compliance:
    """How both bodies answer forces on the patches at rest.

    on_object: (k, 3 o, 3 o) [m/N], o object nodes in the patch. sensor: of all its nodes (3 m, 3 m) [m/N], in its frame.
    dof: the sensor's degrees of freedom in the patch (k, 3 c). free: 1 where the patch may move, 0 where it is held or padded (k, 3 o + 3 c).
    """

    on_object: torch.Tensor
    sensor: torch.Tensor
    dof: torch.Tensor
    free: torch.Tensor

    def pick(self, which: torch.Tensor) -> Compliance:
        """That of some of the touches (j,)."""
        return Compliance(self.on_object[which], self.sensor, self.dof[which], self.free[which])


@dataclass(frozen=True)
class Links:
    """Links of k touches, a each, m directions; padded ones have weight 0.

    on_object: shape values of the object's patch nodes (k, a, o) [-]. node: the sensor's patch nodes (k, a, n). weight: of these (k, a, n) [-].
    world, own: directions in the world and in the sensor's frame (k, a, m, 3), with any factor of the rows in them.
    """

    on_object: torch.Tensor
    node: torch.Tensor
    weight: torch.Tensor
    world: torch.Tensor
    own: torch.Tensor

    def pick(self, which: torch.Tensor) -> Links:
        """Those of some of the touches (j,)."""
        return Links(*(getattr(self, name)[which] for name in ("on_object", "node", "weight", "world", "own")))

    @property
    def rows(self) -> int:
        """Number of rows of a touch."""
        return self.world.shape[1] * self.world.shape[2]

    def jump(self, v: torch.Tensor) -> torch.Tensor:
        """J v (k, a m) for displacements v (k, 3 s)."""
        k, _, split = self.on_object.shape
        world = self.on_object @ v[:, :3 * split].view(k, split, 3)
        sensor = v[:, 3 * split:].view(k, -1, 3)
        at = torch.arange(k, device=v.device)[:, None, None]
        own = (self.weight[:, :, :, None] * sensor[at, self.node]).sum(dim=2)
        return ((self.world * world[:, :, None]).sum(dim=3) + (self.own * own[:, :, None]).sum(dim=3)).flatten(1)

    def push(self, force: torch.Tensor, size: int) -> torch.Tensor:
        """J^T f (k, 3 s) for f (k, a m); ``size``: 3 s."""
        f = force.view(*self.on_object.shape[:2], -1, 1)
        return self.share((f * self.world).sum(dim=2), (f * self.own).sum(dim=2), size)

    def share(self, world: torch.Tensor, own: torch.Tensor, size: int) -> torch.Tensor:
        """Nodal forces (k, 3 s) of a force at every link, given in both frames (k, a, 3)."""
        k, _, split = self.on_object.shape
        on_object = self.on_object.mT @ world
        own = self.weight[:, :, :, None] * own[:, :, None]
        out = torch.zeros((k, size // 3 - split, 3), dtype=own.dtype, device=own.device)
        out.scatter_add_(1, self.node.flatten(1)[:, :, None].expand(-1, -1, 3), own.flatten(1, 2))
        return torch.cat([on_object, out], dim=1).flatten(1)

    def _object_rows(self) -> torch.Tensor:
        k, _, split = self.on_object.shape
        return (self.world[:, :, :, None, :] * self.on_object[:, :, None, :, None]).reshape(k, self.rows, 3 * split)

    def answers(self, compliance: Compliance) -> torch.Tensor:
        """J A (k, a m, 3 s): the displacements of the patch under a unit force along each row."""
        on_object = self._object_rows() @ compliance.on_object
        three = torch.arange(3, device=self.node.device)
        at = torch.arange(len(self.node), device=self.node.device)[:, None, None, None]
        source = compliance.dof[at, 3 * self.node[:, :, :, None] + three].clamp(min=0)  # (k, a, n, 3)
        # whole rows of the table are read faster than picked columns: those are picked from the sums
        table = compliance.sensor[source]  # (k, a, n, 3, 3 m)
        whole = torch.einsum("kan,kamc,kancd->kamd", self.weight, self.own, table).flatten(1, 2)
        own = whole.gather(2, compliance.dof.clamp(min=0)[:, None].expand(-1, whole.shape[1], -1))
        return torch.cat([on_object, own], dim=2) * compliance.free[:, None]

    def gram(self, answers: torch.Tensor) -> torch.Tensor:
        """J X^T (k, a m, r) for rows X (k, r, 3 s)."""
        k, _, split = self.on_object.shape
        out = self._object_rows() @ answers[:, :, :3 * split].mT
        sensor = answers[:, :, 3 * split:].reshape(k, answers.shape[1], -1, 3)
        at = torch.arange(k, device=answers.device)[:, None, None, None]
        row = torch.arange(answers.shape[1], device=answers.device)[None, :, None, None]
        picked = sensor[at, row, self.node[:, None]]  # (k, r, a, n, 3)
        own = torch.einsum("kan,kamc,kranc->kamr", self.weight, self.own, picked)
        return out + own.flatten(1, 2)


def jump(links: list[Links], v: torch.Tensor) -> torch.Tensor:
    """All rows of J v."""
    return torch.cat([link.jump(v) for link in links], dim=1)


def push(links: list[Links], force: torch.Tensor, size: int) -> torch.Tensor:
    """J^T f over all links."""
    parts = force.split([link.rows for link in links], dim=1)
    return sum(link.push(part, size) for link, part in zip(links, parts, strict=True))


def answers(links: list[Links], compliance: Compliance) -> torch.Tensor:
    """All rows of J A."""
    return torch.cat([link.answers(compliance) for link in links], dim=1)


def gram(links: list[Links], rows: torch.Tensor) -> torch.Tensor:
    """J X^T over all links."""
    return torch.cat([link.gram(rows) for link in links], dim=1)


@dataclass(frozen=True)
class LinkStiffness:
    """The contact stiffness J^T J (directions carry the roots) as an operator: ``stiffness @ v`` for v (k, 3 s, 1)."""

    links: list[Links]
    free: torch.Tensor

    def __getitem__(self, which: torch.Tensor) -> LinkStiffness:
        return LinkStiffness([link.pick(which) for link in self.links], self.free[which])

    def __setitem__(self, which: torch.Tensor, other: LinkStiffness) -> None:
        """The stiffness of a pair has no part that a retry would leave out: it is the same."""

    def __matmul__(self, v: torch.Tensor) -> torch.Tensor:
        if not self.links:
            return torch.zeros_like(v)
        return (push(self.links, jump(self.links, v[:, :, 0] * self.free), self.free.shape[1]) * self.free)[:, :, None]


@dataclass(frozen=True)
class LinkBlock:
    """As `touching.ContactBlock`: ``apply`` gives T v with T = J^T (1 + J A J^T)^-1 J. inner: Cholesky factor of the bracket."""

    links: list[Links]
    inner: torch.Tensor
    free: torch.Tensor

    @classmethod
    def of(cls, links: list[Links], compliance: Compliance) -> LinkBlock:
        """From links whose directions carry the roots of the stiffness [sqrt(N/m)]."""
        inner = gram(links, answers(links, compliance))
        inner = 0.5 * (inner + inner.mT)
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(links, torch.linalg.cholesky(inner), compliance.free)

    def pick(self, which: torch.Tensor) -> LinkBlock:
        """That of some of the touches (j,)."""
        return LinkBlock([link.pick(which) for link in self.links], self.inner[which], self.free[which])

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        return push(self.links, torch.cholesky_solve(jump(self.links, v * self.free)[:, :, None], self.inner)[:, :, 0], self.free.shape[1]) * self.free
