"""Sums over the Gauss points of linear faces, handed to the nodes of a patch in a fixed order: the same bits on every
run, on a GPU too.

A table of shape values of every point by every node is mostly zeros where a sheet's faces are small; here a face sums
over its own points first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from vsfsim.physics.contact.patch import Patch
from vsfsim.physics.contact.stiffness_block import ContactBlock


class FaceSums:
    """Which corners of which faces meet at each node, and at each pair of nodes, of B patches.

    Args:
        table: shape values of the points of a face's parts (parts, 6, 6), see `patch.shape_table`. patches: B of
        them. faces: most faces of a patch F.
        nodes: most nodes of a patch s. device: torch device.
    """

    def __init__(self, table: np.ndarray, patches: Sequence[Patch], faces: int, nodes: int, *, device: str):
        self._shares = torch.as_tensor(table.reshape(-1, 6)[:, :3].copy(), device=device)  # (6 parts, 3)
        self._products = (self._shares[:, :, None] * self._shares[:, None, :]).flatten(1)  # (6 parts, 9)
        self._faces, self._nodes = faces, nodes
        corners = [p.local[::len(table), :3] for p in patches]
        padded = np.zeros((len(patches), faces, 3), np.int64)
        for b, c in enumerate(corners):
            padded[b, :len(c)] = c
        self._corners = torch.as_tensor(padded, device=device)
        self._at_node = _slots([c.reshape(-1) for c in corners], nodes, 3 * faces, device)
        pairs = [(nodes * c[:, :, None] + c[:, None, :]).reshape(-1) for c in corners]
        known = [np.unique(p, return_inverse=True) for p in pairs]
        most = max(1, max(len(k) for k, _ in known))
        self._at_pair = _slots([i for _, i in known], most, 9 * faces, device)
        ends = np.full((2, len(patches), most), nodes)  # padded pairs are of a node past the end
        for b, (k, _) in enumerate(known):
            ends[:, b, :len(k)] = k // nodes, k % nodes
        self._one, self._other = torch.as_tensor(ends, device=device)

    def places(self, x: torch.Tensor) -> torch.Tensor:
        """Vectors at the nodes of all patches (B, s, 3) interpolated to the points (B, 6 f parts, 3)."""
        at = self._corners.flatten(1)[:, :, None].expand(-1, -1, 3)
        return (self._shares @ x.gather(1, at).view(len(x), self._faces, 3, 3)).reshape(len(x), -1, 3)

    def nodal(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Forces at the points (k, 6 f parts, 3) [N] as forces on the nodes (k, 3 s) [N], f = F."""
        k = len(columns)
        own = self._shares.T @ force.reshape(k, self._faces, -1, 3)  # (k, f, 3 corners, 3)
        return _sum(own.reshape(k, -1, 3), self._at_node[columns]).flatten(1)

    def pushed(self, columns: torch.Tensor, stiff: torch.Tensor) -> torch.Tensor:
        """Nodes (k, u) of the faces with any stiffness at a point (k, 6 f parts, 3, 3), padded with others to the most
        of any touch, one at the least."""
        k = len(columns)
        on = (stiff.reshape(k, self._faces, -1) != 0.0).any(dim=2).to(torch.float64)
        used = _sum(on.repeat_interleave(3, dim=1)[:, :, None], self._at_node[columns])[:, :, 0] > 0.0
        most = max(1, int(used.sum(dim=1).amax()))
        return torch.sort(used.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :most]

    def matrix(self, columns: torch.Tensor, stiff: torch.Tensor, nodes: torch.Tensor | None = None) -> torch.Tensor:
        """Stiffness at the points (k, 6 f parts, 3, 3) [N/m] as that of the nodes (k, 3 s, 3 s) [N/m], or of some of
        them, ``nodes`` (k, u), alone."""
        k, s = len(columns), self._nodes
        if nodes is None:
            nodes = torch.arange(s, device=stiff.device).expand(k, -1)
        u = nodes.shape[1]
        place = torch.full((k, s + 1), u, device=stiff.device)
        place.scatter_(1, nodes, torch.arange(u, device=stiff.device).expand(k, -1))
        one, other = place.gather(1, self._one[columns]), place.gather(1, self._other[columns])
        at = torch.where((one < u) & (other < u), u * one + other, u * u)  # all others in one place past the end
        own = self._products.T @ stiff.reshape(k, self._faces, -1, 9)  # (k, f, 9 pairs of corners, 9)
        pairs = _sum(own.reshape(k, -1, 9), self._at_pair[columns])
        out = torch.zeros((k, u * u + 1, 9), dtype=stiff.dtype, device=stiff.device)
        out.scatter_(1, at[:, :, None].expand(-1, -1, 9), pairs)
        return out[:, :-1].reshape(k, u, u, 3, 3).transpose(2, 3).reshape(k, 3 * u, 3 * u)

    def block(self, columns: torch.Tensor, stiff: torch.Tensor, free: torch.Tensor,
              compliance: torch.Tensor, series: torch.Tensor | None = None) -> ContactBlock:
        """The stiffness of the nodes that are pushed, to be inverted with the ``compliance`` (k, 3 s, 3 s) [m/N].

        ``columns``, ``stiff``: as for `matrix`; ``free``: 1 where a degree of freedom may move (k, 3 s); ``series``:
        see `ContactBlock.of`.
        """
        nodes = self.pushed(columns, stiff)
        touch = torch.arange(len(columns), device=free.device)[:, None]
        loose = free.view(len(columns), -1, 3)[touch, nodes].flatten(1)
        own = self.matrix(columns, stiff, nodes) * loose[:, :, None] * loose[:, None, :]
        return ContactBlock.joined_of(nodes, own, compliance, series)


def _slots(targets: Sequence[np.ndarray], count: int, nothing: int, device: str) -> torch.Tensor:
    """For every target 0..count-1 the sources that go to it (B, count, m), padded with ``nothing``; ``targets``: of
    every source, one array a touch."""
    most = max(1, max(int(np.bincount(t, minlength=1).max()) if len(t) else 0 for t in targets))
    out = np.full((len(targets), count, most), nothing)
    for b, t in enumerate(targets):
        order = np.argsort(t, kind="stable")
        first = np.searchsorted(t[order], t[order])
        out[b, t[order], np.arange(len(t)) - first] = order
    return torch.as_tensor(out, device=device)


def _sum(values: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    """Values (k, n, w) summed over slots (k, count, m); a slot n is empty."""
    k, _, w = values.shape
    padded = torch.cat([values, values.new_zeros(k, 1, w)], dim=1)
    out = padded.gather(1, at[:, :, 0, None].expand(-1, -1, w))
    for j in range(1, at.shape[2]):
        out += padded.gather(1, at[:, :, j, None].expand(-1, -1, w))
    return out


def nodal_sums(local: torch.Tensor, shapes: torch.Tensor, force: torch.Tensor, nodes: int) -> torch.Tensor:
    """Forces on the s = ``nodes`` of the patches (k, 3 s) of forces at the points (k, 6 f, 3), in a fixed order on a
    CPU; ``local`` and ``shapes`` as for `stiffness_block.SparseStiffness.of`."""
    parts = shapes.mT @ force.view(*local.shape, 3)  # (k, f, 6 nodes, 3)
    out = force.new_zeros(len(local), nodes, 3)
    at = local.long().flatten(1)[:, :, None].expand(-1, -1, 3)
    return out.scatter_add_(1, at, parts.flatten(1, 2)).flatten(1)


def at_points(local: torch.Tensor, shapes: torch.Tensor, nodal: torch.Tensor) -> torch.Tensor:
    """Vectors at the nodes (k, 3 s) interpolated to the points of quadratic faces (k, 6 f, 3), of some touches, face by
    face: a table of all points and nodes is made for all touches, and mostly zeros. ``local`` and ``shapes`` as for
    `nodal_sums`."""
    k, f = local.shape[:2]
    at = local.reshape(k, 6 * f, 1).expand(-1, -1, 3).long()
    return (shapes @ nodal.view(k, -1, 3).gather(1, at).view(k, f, 6, 3)).view(k, 6 * f, 3)
