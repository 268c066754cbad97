"""A membrane's flat mesh made finer where something sharp will touch it.

Triangles are cut in four ("red") while they are longer than wanted; a neighbour that got one node more is cut in two
("green"), one that got two or three in four, so that no node hangs (Bank, Sherman and Weiser 1983). Old nodes keep
their numbers, and the mirror symmetry of the mesh stays where what touches has it.
"""

from __future__ import annotations

import numpy as np

from vsfsim.core.shape import Capsule, Plane, Sphere
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.mesh.membrane import cut
from vsfsim.physics.solve import increments

# of a ball's radius: the longest edge where it touches; see docs/physics.md for what half of it changes
SHARE = 1.0 / 3.0
# of the membrane's edge: the same under bodies with edges, which no mesh resolves. A corner of a cube is pushed back
# by a Punyo, 6 mm deep, with 2.80 N on an even mesh, 2.22 N with this, and 2.20 N on edges of 1.2 mm
SHARP = 0.6
_GROWTH = 0.2  # of the edge with the distance from what touches: bands of one size are then five triangles wide
_LEVELS = 5  # a triangle is cut so often at most
_MOST_NODES = 20_000  # nodes; as many as [sensor] may ask for

Wishes = tuple[tuple[float, tuple[int, ...]], ...]
"""Where a mesh is to be finer: for every body that touches, the edge on the free dome [m] and the nodes of the even
mesh that it meets."""


def wishes(dome: np.ndarray, edge: float, bodies: RigidBodies, poses: np.ndarray, contact_edge: float | None) -> Wishes:
    """Where rigid bodies ask for a finer mesh.

    Args:
        dome: nodes of the free dome (n, 3) [m]. edge: of its mesh [m]. bodies: K of them. poses: their way, in the
        mount frame (T, K, 4, 4).
        contact_edge: the edge where they touch [m], or None for `SHARE` of the radius of balls and capsules, nothing
        for planes and `SHARP` for other bodies.
    """
    gap = np.full((len(bodies), len(dome)), np.inf)
    before = poses[:1]
    for pose in poses:
        for stop in increments.pieces(before, pose[None], edge, bodies):
            for k in range(len(bodies)):
                turn, at = stop[0, k, :3, :3], stop[0, k, :3, 3]
                gap[k] = np.minimum(gap[k], bodies.distance(k, (dome - at) @ turn))
        before = pose[None]
    out = []
    for shape, own in zip(bodies.shapes, gap, strict=True):
        wanted = (contact_edge if contact_edge is not None else SHARE * shape.radius
                  if isinstance(shape, (Sphere, Capsule)) else np.inf if isinstance(shape, Plane) else SHARP * edge)
        if wanted < edge and own.min() < edge:
            # at least the nearest node: a small tip may dent a triangle between its corners
            met = own < max(0.0, float(own.min()) + 1e-9)
            out.append((float(wanted), tuple(int(i) for i in np.flatnonzero(met))))
    return tuple(out)


def finer(flat: np.ndarray, faces: np.ndarray, rim: np.ndarray, semi_axes: tuple[float, float], dome: np.ndarray,
          wishes: Wishes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh with edges near some nodes as long as wished, growing with the distance from them.

    Args:
        flat: places before inflation (n, 2) [m]. faces: (f, 3). rim: its nodes in order (r,). semi_axes: of the rim
        (2,) [m]. dome: nodes of the free dome (n, 3) [m].
        wishes: see `Wishes`.

    Returns:
        flat, faces and rim as the arguments; the first n nodes are the old ones.
    """
    from scipy.spatial import cKDTree

    met = [(edge, cKDTree(dome[list(nodes)])) for edge, nodes in wishes if nodes]
    for _ in range(_LEVELS):
        corners = dome[faces]
        size = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
        wanted = np.full(len(faces), np.inf)
        for edge, tree in met:
            wanted = np.minimum(wanted, np.maximum(edge, _GROWTH * tree.query(corners.mean(axis=1))[0]))
        longer = size > wanted
        if not longer.any():
            break
        if len(flat) + 2 * int(longer.sum()) > _MOST_NODES:
            break
        flat, faces, rim, dome = cut(flat, faces, rim, semi_axes, longer, dome)
    return flat, faces, rim
