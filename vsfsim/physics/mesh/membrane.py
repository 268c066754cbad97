"""Triangle meshes of membranes, each its own mirror image about both axes: a flat ellipse, and a finer one where a body
touches.

The mesh of a sensor's reading has the 390 nodes, 64 of them on the rim, and 714 triangles of the Punyo's published one.
`read_out.npz` holds it for the Punyo's semi-axes: rings from the rim inwards to a line of nodes on the long axis, with
inner nodes in the middle of the triangles around them. For other semi-axes it is stretched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.physics.elements import gas
from vsfsim.physics.mesh.structured import disc

READ_OUT, _RIM = 390, 64  # nodes of the read-out mesh, and of its rim
_PUNYO = 0.05725, 0.040  # semi-axes of the Punyo [m]
_GROWTH = 0.2  # of the edge with the distance from what touches: bands of one size are then five triangles wide
_LEVELS = 5  # a triangle is cut so often at most
_MOST_NODES = 20_000  # nodes; as many as [sensor] may ask for

Wishes = tuple[tuple[float, tuple[int, ...]], ...]
"""Where a mesh is to be finer: for every body that touches, the edge on the free dome [m] and the nodes of the even
mesh that it meets."""


@dataclass(frozen=True)
class TriangleMesh:
    """Linear triangles in space, with the attributes that the solver needs of a mesh."""

    points: np.ndarray
    """Nodes (n, 3) [m]."""
    faces: np.ndarray
    """Triangles, wound outwards (f, 3)."""
    rim: np.ndarray
    """Nodes of the edge in order, counter-clockwise from outside (r,); none if the surface is closed."""
    volume: np.ndarray
    """Volume inside the surface, closed by a cap over the rim (1,) [m^3]."""

    @classmethod
    def of(cls, points: np.ndarray, faces: np.ndarray, rim: np.ndarray) -> TriangleMesh:
        """A mesh and its volume; arguments as the fields."""
        return cls(points, faces, rim, np.array([gas.volume(points, closed(faces, rim))]))

    @property
    def tets(self) -> np.ndarray:
        """None: (0, 10)."""
        return np.zeros((0, 10), np.int32)

    def surface_nodes(self) -> np.ndarray:
        """All nodes (n,)."""
        return np.arange(len(self.points))

    def face_area(self) -> np.ndarray:
        """Areas (f,) [m^2]."""
        a, b, c = (self.points[self.faces[:, k]] for k in range(3))
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    def edge(self, at: np.ndarray | None = None) -> float:
        """Mean length of the edges [m] of the triangles at nodes ``at`` (k,), or of all where there are none."""
        faces = self.faces if at is None or not len(at) else self.faces[np.isin(self.faces, at).any(axis=1)]
        corners = self.points[faces]
        return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def closed(faces: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Faces and a cap over the rim (f + r - 2, 3)."""
    return faces if not len(rim) else np.concatenate([faces, gas.cap(rim)]).astype(np.int32)


def ellipse(a: float, b: float, nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A flat ellipse: for `READ_OUT` nodes the read-out mesh, else rings of about as many.

    Args:
        a, b: semi-axes along x and y [m].
        nodes: number of nodes wished for; a disc of k rings has 1 + 3 k (k + 1).

    Returns:
        Points (n, 2) [m]; triangles (f, 3), counter-clockwise; the rim in order (r,).
    """
    if nodes == READ_OUT:
        with np.load(Path(__file__).with_name("read_out.npz")) as known:
            flat, triangles = known["flat"] * (np.array([a, b]) / _PUNYO), known["faces"].astype(np.int64)
        return flat, triangles, np.arange(_RIM)
    rings = max(2, round(math.sqrt((nodes - 0.25) / 3.0) - 0.5))
    plane, triangles = disc(1.0, rings)
    return plane * [a, b], triangles, np.arange(len(plane) - 6 * rings, len(plane))


def cut(flat: np.ndarray, triangles: np.ndarray, rim: np.ndarray, semi_axes: tuple[float, float], which: np.ndarray,
        dome: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The triangles ``which`` (f,) bool of a flat ellipse cut in four, and their neighbours so that no node hangs.

    Args:
        flat: places (n, 2) [m]. triangles: (f, 3). rim: its nodes in order (r,). semi_axes: of the ellipse (2,) [m].
        dome: other places of the nodes (n, d) [m], which are cut likewise.

    Returns:
        flat, triangles, rim and dome of the new mesh: the first n nodes are the old ones, and those that are new on the
        rim lie on the ellipse.
    """
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, inverse = np.unique(pairs, axis=0, return_inverse=True)
    edge_of = inverse.reshape(-1, 3)
    halved = np.zeros(len(edges), bool)
    halved[edge_of[which]] = True
    while True:
        count = halved[edge_of].sum(axis=1)
        two = count == 2
        if not two.any():
            break
        halved[edge_of[two]] = True
    number = np.full(len(edges), -1)
    number[halved] = len(flat) + np.arange(int(halved.sum()))
    new_flat, new_dome = (np.concatenate([p, p[edges[halved]].mean(axis=1)]) for p in (flat, dome))
    m = number[edge_of]
    t, four = triangles, count == 3
    quarters = ((t[:, 0], m[:, 0], m[:, 2]), (m[:, 0], t[:, 1], m[:, 1]), (m[:, 2], m[:, 1], t[:, 2]),
                (m[:, 0], m[:, 1], m[:, 2]))
    parts = [triangles[count == 0], *(np.stack(quarter, axis=1)[four] for quarter in quarters)]
    for k in range(3):
        own = (count == 1) & (m[:, k] >= 0)
        a, b, c = (t[own, (k + j) % 3] for j in range(3))
        parts += [np.stack([a, m[own, k], c], axis=1), np.stack([m[own, k], b, c], axis=1)]
    known = {(int(i), int(j)): int(n) for (i, j), n in zip(edges[halved], number[halved], strict=True)}
    loop: list[int] = []
    for i, j in zip(rim.tolist(), np.roll(rim, -1).tolist(), strict=True):
        loop.append(i)
        between = known.get((min(i, j), max(i, j)))
        if between is not None:
            new_flat[between] /= np.sqrt(((new_flat[between] / semi_axes) ** 2).sum())
            loop.append(between)
    return new_flat, np.concatenate(parts).astype(triangles.dtype), np.array(loop), new_dome


def finer(flat: np.ndarray, faces: np.ndarray, rim: np.ndarray, semi_axes: tuple[float, float], dome: np.ndarray,
          wishes: Wishes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mesh with edges near some nodes as long as wished, growing with the distance from them.

    Triangles are cut in four ("red") while they are longer than wanted; a neighbour that got one node more is cut in
    two ("green"), one that got two or three in four, so that no node hangs (Bank, Sherman and Weiser 1983). Old nodes
    keep their numbers, and the mirror symmetry of the mesh stays where what touches has it.

    Args:
        flat: places before inflation (n, 2) [m]. faces: (f, 3). rim: its nodes in order (r,). semi_axes: of the rim
        (2,) [m]. dome: nodes of the free dome (n, 3) [m].
        wishes: see `Wishes`.

    Returns:
        flat, faces and rim as the arguments; the first n nodes are the old ones.
    """
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
