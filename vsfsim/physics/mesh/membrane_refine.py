"""A membrane's flat mesh made finer where something sharp will touch it.

Triangles are cut in four ("red") while they are longer than wanted; a neighbour that got one node more is cut in two
("green"), one that got two or three in four, so that no node hangs (Bank, Sherman and Weiser 1983). Old nodes keep
their numbers, and the mirror symmetry of the mesh stays where what touches has it.
"""

from __future__ import annotations

import numpy as np

from vsfsim.physics.mesh.membrane import cut

_GROWTH = 0.2  # of the edge with the distance from what touches: bands of one size are then five triangles wide
_LEVELS = 5  # a triangle is cut so often at most
_MOST_NODES = 20_000  # nodes; as many as [sensor] may ask for

Wishes = tuple[tuple[float, tuple[int, ...]], ...]
"""Where a mesh is to be finer: for every body that touches, the edge on the free dome [m] and the nodes of the even
mesh that it meets."""


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
