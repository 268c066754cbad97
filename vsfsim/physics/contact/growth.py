"""How the patch of a touch grows: cuts of its faces, and what the contact points remember of friction when they
change."""

from __future__ import annotations

import numpy as np

from vsfsim.physics.contact.patch import CUTS, Patch
from vsfsim.physics.mesh.quadratic import QuadraticMesh

Memory = tuple[np.ndarray, ...]
"""Friction state of the Gauss points of a touch: anchors (6 f, 3) [m], their owners (6 f,), limits (6 f,) [N] and
normals of the tangent planes (6 f, 3) [-]."""


def finer(cuts: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The next larger number of cuts of the faces ``where`` (f,) bool; the largest stays."""
    up = np.array(CUTS)[np.minimum(np.searchsorted(CUTS, cuts) + 1, len(CUTS) - 1)]
    return np.where(where, np.maximum(up, cuts), cuts)


def neighbours(mesh: QuadraticMesh, faces: np.ndarray) -> np.ndarray:
    """The boundary triangles that share a node with some of ``faces`` (f,), these included."""
    near = np.zeros(len(mesh.points), bool)
    near[mesh.faces[faces]] = True
    return np.flatnonzero(near[mesh.faces].any(axis=1))


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
