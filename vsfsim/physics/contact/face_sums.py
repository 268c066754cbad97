"""Between the contact points of the parts of faces and the nodes of their patches.

``local`` (k, f, 6) are the nodes of the parts of k patches, and ``shapes`` (k, f, 6 points, 6 nodes) the shape values
of their points. Sums are taken in a fixed order, on a GPU too: there `index_put_` sorts what it accumulates.
"""

from __future__ import annotations

import torch


def nodal_sums(local: torch.Tensor, shapes: torch.Tensor, at_points: torch.Tensor, nodes: int) -> torch.Tensor:
    """Forces (k, s, c) on the s = ``nodes`` of the patches of forces ``at_points`` (k, 6 f, c)."""
    parts = (shapes.mT @ at_points.reshape(*local.shape, -1)).flatten(1, 2)
    touch = torch.arange(len(local), device=local.device)[:, None]
    out = parts.new_zeros(len(local), nodes, parts.shape[2])
    return out.index_put_((touch, local.long().flatten(1)), parts, accumulate=True)


def at_points(local: torch.Tensor, shapes: torch.Tensor, nodal: torch.Tensor) -> torch.Tensor:
    """Vectors at the nodes (k, s, 3) interpolated to the points of the faces (k, 6 f, 3)."""
    k, f = local.shape[:2]
    at = local.reshape(k, 6 * f, 1).expand(-1, -1, 3).long()
    return (shapes @ nodal.gather(1, at).view(k, f, 6, 3)).view(k, 6 * f, 3)
