"""How the patch of a touch grows: cuts of its faces, and what the contact points remember of friction when they
change."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree

from vsfsim.physics.contact.body_points import Padded
from vsfsim.physics.contact.patch import CUTS, Patch
from vsfsim.physics.mesh.quadratic import QuadraticMesh

_APART = 10.0  # of the mesh's size: distance in which points of different faces are put apart


def finer(cuts: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The next larger number of cuts of the faces ``where`` (f,) bool; the largest stays."""
    up = np.array(CUTS)[np.minimum(np.searchsorted(CUTS, cuts) + 1, len(CUTS) - 1)]
    return np.where(where, np.maximum(up, cuts), cuts)


def neighbours(mesh: QuadraticMesh, faces: np.ndarray) -> np.ndarray:
    """The boundary triangles that share a node with some of ``faces`` (f,), these included."""
    near = np.zeros(len(mesh.points), bool)
    near[mesh.faces[faces]] = True
    return np.flatnonzero(near[mesh.faces].any(axis=1))


def grow(patches: list[Patch], cuts: np.ndarray, touches: Sequence[int], met: np.ndarray, cut: np.ndarray,
         mesh: QuadraticMesh, make: Callable[[int, np.ndarray], Patch]) -> None:
    """Grow the patches (B) of some ``touches``, in place.

    Args:
        patches, touches: see above.
        cuts: parts along the edge of each boundary triangle (B, F), likewise in place.
        met: triangles outside the patches that meet a body (B, F) bool.
        cut: triangles that get more points (B, F) bool.
        mesh: the mesh.
        make: the patch of a touch over some triangles (f,).
    """
    for b in touches:
        extra = np.flatnonzero(met[b])
        if len(extra) or cut[b].any():
            cuts[b] = finer(cuts[b], cut[b])
            patches[b] = make(b, np.union1d(patches[b].faces, neighbours(mesh, extra)))


def remember(tensors: tuple[torch.Tensor, ...], kept: tuple[torch.Tensor, ...], points: tuple[Padded, Padded],
             touches: Sequence[int], rest: np.ndarray, moved: torch.Tensor, turn: np.ndarray) -> None:
    """Write the friction state of some ``touches`` into the ``tensors`` of their contact points: anchors (B, 6 f, 3)
    [m], their owners (B, 6 f), limits (B, 6 f) [N] and normals of the tangent planes (B, 6 f, 3) [-].

    Every point takes what the nearest of the old points on its face, or the same point of a body, remembers: its
    anchor moved along, its limit scaled by the stiffness. One whose face was not in the patch remembers nothing.

    Args:
        tensors, touches: see above.
        kept: such tensors of the old points.
        points: the old points and those of the tensors.
        rest: positions of the mesh's nodes at rest (n, 3) [m].
        moved: their displacements at the beginning of the step (3 n, B) [m].
        turn: rotations of the bodies then (B, K, 3, 3).
    """
    old, new = points
    if old is new:
        at = list(touches)
        for mine, theirs in zip(tensors, kept, strict=True):
            mine[at] = theirs[at]
        return
    apart = _APART * float(np.ptp(rest, axis=0).max())
    for b in touches:
        before = rest + moved[:, b].cpu().numpy().reshape(-1, 3)
        was, now = (np.flatnonzero(p.stiffness[b]) for p in points)
        for mine, nothing in zip(tensors, (0.0, -1, 0.0, 0.0), strict=True):
            mine[b] = nothing
        if not len(was):
            continue
        there, here = (np.column_stack([p.places(b, rest)[at], apart * p.key[b, at // 6]])
                       for p, at in zip(points, (was, now), strict=True))
        away, near = cKDTree(there).query(here)
        now, was = now[away < 0.5 * apart], was[near[away < 0.5 * apart]]
        anchor, owner, limit, across = (t[b].cpu().numpy()[was] for t in kept)
        body = np.where(owner < -1, -2 - owner, np.maximum(owner, 0))
        shift = new.places(b, before)[now] - old.places(b, before)[was]
        ratio = new.stiffness[b].ravel()[now] / old.stiffness[b].ravel()[was]
        for mine, values in zip(tensors, (anchor + np.einsum("qji,qj->qi", turn[b, body], shift), owner, limit * ratio,
                                          across), strict=True):
            mine[b, now] = torch.as_tensor(values, device=mine.device)
