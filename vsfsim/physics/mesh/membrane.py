"""Triangle meshes of membranes: a flat ellipse of any number of nodes, the same every time and mirrored about both
axes.

The ellipse is laid out in rings, each the rim's ellipse with both semi-axes shorter by the same width, down to a line
of nodes on the long axis. Every ring has a node on the long axis at both ends and a number of nodes that is even, so
that the strip between two rings can be triangulated in one half and mirrored. Near the middle of a circle the line is
one node.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.physics.elements import gas
from vsfsim.physics.mesh.quadratic import edges_of

# nodes in all and on the rim of the Punyo's published mesh; Euler's formula then gives its 714 triangles
READ_OUT, _RIM = 390, 64
_SMOOTHINGS = 30
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
    """A flat ellipse of exactly ``nodes`` nodes, with edges of one length; for `READ_OUT` nodes the read-out mesh.

    Args:
        a, b: semi-axes along x and y [m], a >= b.
        nodes: number of nodes, 30 or more.

    Returns:
        Points (n, 2) [m], the rim first; triangles (f, 3), counter-clockwise; the rim in order (r,).
    """
    assert a >= b > 0.0 and nodes >= 30
    inside = nodes + 0.5 * _perimeter(a, b) / math.sqrt(math.pi * a * b / nodes)
    edge = math.sqrt(2.0 / math.sqrt(3.0) * math.pi * a * b / inside)
    rim = _RIM if nodes == READ_OUT else max(8, 4 * round(_perimeter(a, b) / edge / 4))
    rows = max(1, round(b / (edge * math.sqrt(0.75))))
    counts, middle = _counts(a, b, rim, nodes, rows)
    rings = [_ring(a - b * k / rows, b - b * k / rows, n) for k, n in enumerate(counts)]
    line = np.zeros((middle, 2))
    if middle > 1:
        line[:, 0] = np.linspace(-1.0, 1.0, middle) * max(a - b, 0.3 * (middle - 1) * b / rows)
    points = np.concatenate([*rings, line])
    start = np.cumsum([0, *counts])
    loops = [np.arange(start[k], start[k + 1]) for k in range(len(counts))]
    # around the line and back, from its right end
    ends = start[-1] + np.arange(middle)
    loops.append(np.concatenate([ends[::-1], ends[1:-1]]) if middle > 1 else ends)
    triangles = np.concatenate([_strip(points, outer, inner) for outer, inner in itertools.pairwise(loops)])
    points = _smooth(points, triangles, rim)
    return points, triangles, np.arange(rim)


def _perimeter(a: float, b: float) -> float:
    """Of an ellipse [m] (Ramanujan 1914)."""
    return math.pi * (3.0 * (a + b) - math.sqrt((3.0 * a + b) * (a + 3.0 * b)))


def _counts(a: float, b: float, rim: int, nodes: int, rows: int) -> tuple[list[int], int]:
    """Nodes of the rings from the rim inwards, multiples of 4 that add up to ``nodes`` with those of the line in the
    middle."""
    while True:
        length = np.array([_perimeter(a - b * k / rows, b - b * k / rows) for k in range(1, rows)])
        rest = nodes - rim
        row = b / rows
        middle_wish = max(1.0, 2.0 * (a - b) / (1.1 * row) + 1.0)
        middle = max(1, round(middle_wish))
        # the rings have multiples of 4: the line gets the nearest number with the right remainder
        choice = [m for m in range(1, middle + 5) if (rest - m) % 4 == 0]
        middle = min(choice, key=lambda m: (abs(m - middle_wish), m))
        rings = (rest - middle) // 4
        if rows > 1 and rings < rows - 1:
            rows -= 1
            continue
        if rows == 1:
            return [rim], rest
        share = length / length.sum() * rings
        whole = np.maximum(1, np.floor(share)).astype(int)
        while whole.sum() != rings:
            off = share - whole
            k = int(off.argmax()) if whole.sum() < rings else int(np.where(whole > 1, off, np.inf).argmin())
            whole[k] += 1 if whole.sum() < rings else -1
        return [rim, *(4 * int(n) for n in whole)], middle


def _ring(a: float, b: float, count: int) -> np.ndarray:
    """``count`` points at equal arc lengths of an ellipse, from (a, 0) on; one quarter and its mirror images."""
    angle = np.linspace(0.0, 0.5 * math.pi, 2001)
    fine = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    at = np.interp(np.linspace(0.0, way[-1], count // 4 + 1), way, angle)
    quarter = np.stack([a * np.cos(at), b * np.sin(at)], axis=1)
    quarter[0, 1] = quarter[-1, 0] = 0.0
    half = np.concatenate([quarter, (quarter * [-1.0, 1.0])[-2::-1]])
    return np.concatenate([half, (half * [1.0, -1.0])[-2:0:-1]])


def _strip(points: np.ndarray, outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Triangles between two loops that both begin on the +x axis: one quarter by the shorter diagonal each time, the
    others its mirror images."""
    if len(inner) == 1:
        return np.stack([outer, np.roll(outer, -1), np.full(len(outer), inner[0])], axis=1)
    n, m = len(outer), len(inner)
    i = j = 0
    quarter: list[tuple[int, int, int]] = []  # nodes of the outer loop, then n plus those of the inner one
    while i < n // 4 or j < m // 4:
        # on the long axis a triangle of the line and the ring's first node would have no area
        outward = j >= m // 4 or i == 0 or bool(
            i < n // 4 and np.linalg.norm(points[outer[i + 1]] - points[inner[j]])
            <= np.linalg.norm(points[outer[i]] - points[inner[j + 1]]))
        quarter.append((i, i + 1, n + j) if outward else (i, n + j + 1, n + j))
        i, j = (i + 1, j) if outward else (i, j + 1)
    first = np.array(quarter)
    steps, inward = np.arange(n), np.arange(m)
    x = np.concatenate([(n // 2 - steps) % n, n + (m // 2 - inward) % m])  # mirrored in x, and in y
    y = np.concatenate([-steps % n, n + -inward % m])
    four = np.stack([first, x[first][:, ::-1], y[x[first]], y[first][:, ::-1]], axis=1).reshape(-1, 3)
    out = np.concatenate([outer, inner])[four]
    if m % 4 == 2:
        # the middle of a line with an even number of nodes is an edge, of triangles that are their own mirror images
        j = m // 4
        out = np.concatenate([out, [(outer[n // 4], inner[j + 1], inner[j]),
                                    (outer[3 * n // 4], inner[-j % m], inner[(-j - 1) % m])]])
    return out[[len(set(corners)) == 3 for corners in out.tolist()]]


def _smooth(points: np.ndarray, triangles: np.ndarray, rim: int) -> np.ndarray:
    """Inner nodes moved to the middle of the triangles around them, by area, again and again: evens out areas and keeps
    the mirror symmetry."""
    out = points.copy()
    for _ in range(_SMOOTHINGS):
        a, b, c = (out[triangles[:, k]] for k in range(3))
        area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        middle = (a + b + c) / 3.0
        total, weight = np.zeros_like(out), np.zeros(len(out))
        for k in range(3):
            np.add.at(total, triangles[:, k], area[:, None] * middle)
            np.add.at(weight, triangles[:, k], area)
        out[rim:] = (total / weight[:, None])[rim:]
    return out


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
    edges, edge_of = edges_of(triangles, [[0, 1], [1, 2], [2, 0]])
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
