"""How the patch of a touch grows: cuts of its faces, and what the contact points remember of friction when they
change."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from vsfsim.physics.contact.patch import CUTS, Patch
from vsfsim.physics.mesh.quadratic import QuadraticMesh

Memory = tuple[np.ndarray, ...]
"""Friction state of the Gauss points of a touch: anchors (6 f, 3) [m], their owners (6 f,), limits (6 f,) [N] and
normals of the tangent planes (6 f, 3) [-]."""


@dataclass(frozen=True)
class Met:
    """The points of the bodies that one touch meets (n)."""

    sample: np.ndarray
    """Which of the points (n,)."""
    face: np.ndarray
    """Boundary triangle that each meets (n,)."""
    values: np.ndarray
    """Shape values of the place on it (n, 6)."""
    normal: np.ndarray
    """Direction in which the object is left there (n, 3) [-], world."""
    gap: np.ndarray
    """Gap there when it was found (n,) [m], negative inside."""

    def pick(self, which: np.ndarray) -> Met:
        """Some of them."""
        return Met(self.sample[which], self.face[which], self.values[which], self.normal[which], self.gap[which])

    def places(self, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Where they lie (n, 3) [m] on ``faces`` (f, 6) whose nodes are at ``points`` (m, 3) [m]."""
        return np.einsum("na,nac->nc", self.values, points[faces[self.face]])


NONE = Met(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 6)), np.zeros((0, 3)), np.zeros(0))
"""No point."""


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
         mesh: QuadraticMesh, make: Callable[[int, np.ndarray], Patch],
         ready: Callable[[list[np.ndarray]], bool]) -> None:
    """Grow the patches (B) of some ``touches``, in place, unless time is over before all is ``ready`` for them.

    Args:
        patches, touches: see above.
        cuts: parts along the edge of each boundary triangle (B, F), likewise in place.
        met: triangles outside the patches that meet a body (B, F) bool.
        cut: triangles that get more points (B, F) bool.
        mesh: the mesh.
        make: the patch of a touch over some triangles (f,).
        ready: makes what patches of these nodes (B of (s,)) need, and says whether there was time for it.
    """
    old, before = list(patches), cuts.copy()
    for b in touches:
        extra = np.flatnonzero(met[b])
        if len(extra) or cut[b].any():
            cuts[b] = finer(cuts[b], cut[b])
            patches[b] = make(b, np.union1d(patches[b].faces, neighbours(mesh, extra)))
    if not ready([patch.nodes for patch in patches]):
        patches[:], cuts[:] = old, before


def carry(old: Patch, new: Patch, memory: Memory, table: np.ndarray, rest: np.ndarray, before: np.ndarray,
          turn: np.ndarray) -> Memory:
    """What the points of a new patch remember of friction, from those of an old one.

    A face with the same points keeps their memory. A point of a face that was cut anew takes that of the nearest old
    point of the face, its anchor moved along, its limit scaled by the stiffness.

    Args:
        old, new: the patches.
        memory: of the old patch's points, as its tensors hold it (padding at the end is not read).
        table: shape values of all parts (P, 6, 6).
        rest: positions of the mesh's nodes at rest (n, 3) [m].
        before: positions of the mesh's nodes at the beginning of the step (n, 3) [m].
        turn: rotation of the bodies at the beginning of the step (K, 3, 3).
    """
    count = 6 * len(new.part)
    anchor, owner, limit, across = (np.zeros((count, *m.shape[1:]), m.dtype) for m in memory)
    owner[:] = -1
    starts_old, starts_new = 6 * old.starts(), 6 * new.starts()
    place = {int(f): i for i, f in enumerate(old.faces)}
    for i, face in enumerate(new.faces):
        k = place.get(int(face))
        if k is None:
            continue
        a, b = slice(starts_old[k], starts_old[k] + 6 * old.cuts[k] ** 2), slice(starts_new[i], starts_new[i]
                                                                                  + 6 * new.cuts[i] ** 2)
        if old.cuts[k] == new.cuts[i]:
            anchor[b], owner[b], limit[b], across[b] = (m[a] for m in memory)
            continue
        if not (memory[1][a] != -1).any():
            continue
        at_rest, at_before = [], []
        for patch, part in ((old, old.starts()[k]), (new, new.starts()[i])):
            faces = patch.cuts[k if patch is old else i] ** 2
            values = table[patch.part[part:part + faces]].reshape(-1, 6)
            nodes = patch.nodes[patch.local[part]]
            at_rest.append(values @ rest[nodes])
            at_before.append(values @ before[nodes])
        near = np.linalg.norm(at_rest[1][:, None] - at_rest[0][None], axis=2).argmin(axis=1)
        own = memory[1][a][near]
        body = np.where(own < -1, -2 - own, np.maximum(own, 0))
        shift = np.einsum("qji,qj->qi", turn[body], at_before[1] - at_before[0][near])
        anchor[b] = memory[0][a][near] + shift
        ratio = new.stiffness.ravel()[b] / old.stiffness.ravel()[a][near]
        owner[b], limit[b], across[b] = own, memory[2][a][near] * ratio, memory[3][a][near]
    return anchor, owner, limit, across


def restore(touches: Sequence[int], tensors: tuple[torch.Tensor, ...], state: tuple[Any, ...],
            present: tuple[Sequence[Patch], Sequence[Met]], table: np.ndarray, body: np.ndarray, mesh: QuadraticMesh,
            moved: torch.Tensor, turn: np.ndarray) -> None:
    """Write a friction state into the ``tensors`` of `Memory`, of B touches each: as it was where the contact points
    are the same, else what each point remembers (`remembered`).

    Args:
        touches: those to write.
        tensors: anchors, owners, limits and normals.
        state: patches, points of bodies and tensors of B touches when it was kept.
        present: patches and points of bodies now (B).
        table, body: see `remembered`.
        mesh: of the object.
        moved: displacements at the beginning of the step (3 n, B) [m].
        turn: rotations of the bodies then (B, K, 3, 3).
    """
    patches, met, *kept = state
    for b in touches:
        if patches[b] is present[0][b] and met[b] is present[1][b] and kept[0].shape == tensors[0].shape:
            for mine, theirs in zip(tensors, kept, strict=True):
                mine[b] = theirs[b]
            continue
        u = moved[:, b].cpu().numpy()
        memory = remembered((patches[b], met[b]), (present[0][b], present[1][b]),
                            tuple(t[b].cpu().numpy() for t in kept), table, body, mesh.faces,
                            (mesh.points, mesh.points + u.reshape(-1, 3)), turn[b])
        for mine, values in zip(tensors, memory, strict=True):
            mine[b] = -1 if mine is tensors[1] else 0
            mine[b, :len(values)] = torch.as_tensor(values, device=mine.device)


def remembered(old: tuple[Patch, Met], new: tuple[Patch, Met], memory: Memory, table: np.ndarray,
               body: np.ndarray, faces: np.ndarray, at: tuple[np.ndarray, np.ndarray],
               turn: np.ndarray) -> Memory:
    """What all contact points of a touch remember of friction: those of its patch (`carry`), then those of the
    bodies (`carry_points`), the first of six each.

    Args:
        old, new: patches and points of bodies before and now.
        memory: of the old points.
        table: shape values of the parts of faces (p, 6, 6).
        body: the body of every point of a body.
        faces: nodes of the boundary triangles.
        at: positions of the nodes at rest and at the beginning of the step (n, 3) [m].
        turn: rotations of the bodies then (K, 3, 3).
    """
    own = carry(old[0], new[0], memory, table, *at, turn)
    first, count = 6 * len(old[0].part), len(old[1].sample)
    theirs = carry_points(old[1], new[1], tuple(m[first:first + 6 * count:6] for m in memory), body, faces, at[1], turn)
    out = []
    for mine, more in zip(own, theirs, strict=True):
        wide = np.full((6 * len(more), *more.shape[1:]), -1 if more.dtype == np.int32 else 0, more.dtype)
        wide[::6] = more
        out.append(np.concatenate([mine, wide]))
    return tuple(out)


def carry_points(old: Met, new: Met, memory: tuple[np.ndarray, ...], body: np.ndarray, faces: np.ndarray,
                 before: np.ndarray, turn: np.ndarray) -> tuple[np.ndarray, ...]:
    """What the points ``new`` (n) remember of friction from those of ``old``: the same point of a body on another place
    of the object keeps its limit, and its anchor moves along with the place.

    Args:
        old, new: the points before and now.
        memory: anchors (m, 3) [m], owners (m,), limits (m,) [N] and normals (m, 3) of ``old``.
        body: the body of every point.
        faces: nodes of the boundary triangles (F, 6).
        before: positions of all nodes at the beginning of the step (k, 3) [m].
        turn: rotations of the bodies then (K, 3, 3).
    """
    place = {int(s): i for i, s in enumerate(old.sample)}
    at = np.array([place.get(int(s), -1) for s in new.sample], int)
    shift = np.zeros((len(at), 3))
    if len(old.sample):
        shift = new.places(faces, before) - old.places(faces, before)[at]
    anchor, owner, limit, across = (np.zeros((len(at), *m.shape[1:]), m.dtype) for m in memory)
    owner[:] = -1
    known = at >= 0
    anchor[known] = memory[0][at[known]] + np.einsum("nji,nj->ni", turn[body[new.sample[known]]], shift[known])
    owner[known], limit[known], across[known] = (m[at[known]] for m in memory[1:])
    return anchor, owner, limit, across
