"""Structured meshes of block, ball and round bar: corner tetrahedra by construction, the same every time.

A ball is 20 tetrahedra of an icosahedron, a disc 6 triangles of a hexagon, each subdivided n times and
pushed out shell by shell: no corner of a cube has to be flattened, and every boundary vertex lies on the
true surface, as do the nodes that `quadratic` puts between them, by `on_round`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.hexes import split_hexes, split_prisms
from vsfsim.core.solid import tet_volumes

# Beyond this a mesh would not fit in memory; a slip of units is the usual cause.
MAX_CELLS = 2_000_000
# Neighbouring cells of a graded grid differ by this factor at most; more shows up as error at the jump.
GROWTH = 1.3
# Far from the focus a cell is at most this many times larger than near it.
COARSEST = 3.0
# Cells across a part inside a block.
ACROSS = 2
# Growth of cells away from thin parts, tried in turn, and the most cells that a block may have for their sake: so many
# times those without, and so many more.
_SLOPES, _MOST_CELLS = (0.24, 0.5, 1.0), (2, 3000)
# A face of a part is put onto a neighbouring plane that is nearer than this share of the part's thickness.
_SAME = 0.02


def box(size: tuple[float, float, float], resolution: float, *,
        focus: np.ndarray | None = None, parts: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A block with its base centre at the origin, five tetrahedra a cell.

    Five a cell (mirrored from cell to cell) has dihedral angles of 55 to 90 degrees in a cube, where Kuhn's
    six have 45 to 90 and need a seventh more edges, that is unknowns. With an even number of cells in x and y
    it is also symmetric under reflection, so a centred press has no sideways force.

    Args:
        size: edges (3,) [m].
        resolution: largest cell edge [m]; with ``focus``, the edge near it.
        focus: points (k, 3) [m] around which the grid stays fine; elsewhere it coarsens to 3x, or to the block's least
        edge.
        parts: low and high corners of boxes inside (p, 2, 3) [m], whose faces become planes of the grid with two cells
        at least between them, unless that takes far more cells.

    Returns:
        Vertices (n, 3) [m] and positively oriented corners (m, 4).
    """
    focus = None if focus is None else np.asarray(focus, float).reshape(-1, 3)
    low = (-0.5 * size[0], -0.5 * size[1], 0.0)
    # a plate bends everywhere: away from the focus its cells grow to its thickness, not to what a thick block can do
    # with
    coarsest = min(COARSEST, max(1.0, min(size) / resolution))
    # two cells at least from the base to the top: a pad bonded to its base is 4 % too stiff with one
    finest = (resolution, resolution, min(resolution, 0.5 * size[2]))
    def lines(inside: np.ndarray | None, slope: float) -> list[np.ndarray]:
        return [grid_line(low[a], low[a] + size[a], finest[a], even=a < 2, coarsest=coarsest,
                          focus=None if focus is None else focus[:, a],
                          parts=None if inside is None else inside[:, :, a], slope=slope) for a in range(3)]

    def cells(ticks: list[np.ndarray]) -> int:
        return math.prod(len(t) - 1 for t in ticks)

    ticks = lines(None, 1.0)
    if parts is not None and len(parts):
        most = _MOST_CELLS[0] * cells(ticks) + _MOST_CELLS[1]
        finer = (lines(parts, slope) for slope in _SLOPES)
        ticks = next((found for found in finer if cells(found) <= most), ticks)
    shape = tuple(len(t) for t in ticks)
    vertices = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    index = np.arange(len(vertices)).reshape(shape)
    parity = np.indices(shape).sum(axis=0).reshape(-1) % 2
    tets, _ = split_hexes(grid_hexes(index), parity * len(vertices) + np.arange(len(vertices)))
    return vertices, tets


def check_cells(edges: Sequence[float] | np.ndarray, resolution: float, where: str) -> None:
    """Refuse a bounding box of ``edges`` (3,) [m] with more than `MAX_CELLS` cells.

    Raises:
        SceneError: there are more.
    """
    cells = math.prod(math.ceil(edge / resolution) for edge in edges)
    if cells > MAX_CELLS:
        raise SceneError(f"{where}: resolution {resolution:g} m cuts a body of {' x '.join(f'{e:.4g}' for e in edges)} "
                         f"m into about {cells:.1e} cells, and {MAX_CELLS:.0e} is the most; use a coarser resolution, "
                         f"and check that both are in metres.")


def grid_hexes(index: np.ndarray) -> np.ndarray:
    """Corners (c, 8) of the cells of a grid of vertex numbers ``index`` (I+1, J+1, K+1)."""
    steps = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
    ni, nj, nk = (n - 1 for n in index.shape)
    return np.stack([index[i:i + ni, j:j + nj, k:k + nk].reshape(-1) for i, j, k in steps], axis=1)


def grid_line(low: float, high: float, resolution: float, *, even: bool = False,
              focus: np.ndarray | None = None, coarsest: float = COARSEST, parts: np.ndarray | None = None,
              slope: float = 0.24) -> np.ndarray:
    """Ticks of one axis [m], at most ``resolution`` apart; with ``focus`` (k,) [m] that holds near it only, and
    ``coarsest`` times it elsewhere.

    The spacing wished for grows linearly with the distance to the focus, which makes cells grow by a
    constant factor; the ticks are the equal parts of the integral of its inverse. The ends of ``parts`` (p, 2) [m] are
    ticks, too; two cells at least lie between them, and cells grow from there by ``slope`` times the distance.
    """
    ends = np.zeros((0, 2)) if parts is None else np.clip(np.sort(np.asarray(parts, float), axis=1), low, high)
    inside = ends[ends[:, 1] - ends[:, 0] > 1e-9 * (high - low)]
    thin = _SAME * (inside[:, 1] - inside[:, 0]).min(initial=high - low)
    planes = [low]
    for plane in sorted({*inside.ravel().tolist(), high}):
        if plane - planes[-1] > thin:
            planes.append(plane)
    planes[-1] = high
    own = [(a, b, (b - a) / ACROSS) for a, b in inside]  # cells of the parts, and of what lies between two planes
    own += [(a, b, b - a) for a, b in itertools.pairwise(planes)]
    ticks = [np.array([low])]
    for a, b in itertools.pairwise(planes):
        x = np.linspace(a, b, 4001)
        wished = _wished(x, resolution, focus, coarsest)
        for start, stop, cell in own:
            if cell < resolution:
                wished = np.minimum(wished, cell + slope * np.maximum(np.maximum(start - x, x - stop), 0.0))
        sums = np.concatenate([[0.0], np.cumsum(0.5 * (1.0 / wished[1:] + 1.0 / wished[:-1]) * np.diff(x))])
        count = max(1, math.ceil(sums[-1] - (1e-6 if len(inside) else 1e-9)))
        count += count % 2 if even and a < 0.5 * (low + high) - 1e-9 < b else 0
        ticks.append(np.interp(np.linspace(0.0, sums[-1], count + 1), sums, x)[1:])
        ticks[-1][-1] = b
    return np.concatenate(ticks)


def _wished(x: np.ndarray, resolution: float, focus: np.ndarray | None, coarsest: float) -> np.ndarray:
    if focus is None or not len(focus):
        return np.full(len(x), resolution)
    away = np.abs(x[:, None] - np.asarray(focus, float)[None, :]).min(axis=1)
    # A cell of the local size h next to one of h (1 + slope): the slope stays a little under the growth allowed.
    slope = 0.9 * math.log(GROWTH)
    return resolution * np.minimum(1.0 + slope * np.maximum(away / resolution - 1.5, 0.0), coarsest)


def disc(radius: float, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 2) [m] and counter-clockwise triangles (f, 3) of a disc around the origin."""
    points = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        angle = 2.0 * math.pi * np.arange(6 * ring) / (6 * ring)
        points.append(radius * ring / rings * np.stack([np.cos(angle), np.sin(angle)], axis=1))

    def number(ring: int, step: int) -> int:
        return 0 if ring == 0 else 1 + 3 * ring * (ring - 1) + step % (6 * ring)

    triangles = []
    for ring in range(1, rings + 1):
        for sector in range(6):
            for s in range(ring):
                outer, inner = sector * ring + s, sector * (ring - 1) + s
                triangles.append((number(ring, outer), number(ring, outer + 1), number(ring - 1, inner)))
                if s < ring - 1:
                    triangles.append((number(ring, outer + 1), number(ring - 1, inner + 1), number(ring - 1, inner)))
    return np.concatenate(points), np.array(triangles)


def on_round(centre: tuple[float, ...], across: tuple[float, ...], radius: float, points: np.ndarray) -> np.ndarray:
    """The nearest points (k, 3) of a ball or an endless cylinder to ``points`` (k, 3) [m].

    Args:
        centre: a point of its centre or axis (3,) [m].
        across: 1 for the coordinates that its radius counts in, 0 along its axis (3,).
        radius: [m].
    """
    off = (points - np.array(centre)) * np.array(across)
    return points + off * (radius / np.maximum(np.linalg.norm(off, axis=1), 1e-300) - 1.0)[:, None]


def cylinder(radius: float, height: float, resolution: float, *,
             parts: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A cylinder along +z with the centre of its base at the origin.

    Args:
        radius, height: [m]. resolution: largest edge length aimed at, along the axis and the radius [m].
        parts: low and high ends of layers inside (p, 2) [m], see `grid_line`.
    """
    rings = max(2, math.ceil(radius / resolution - 1e-9))
    plane, triangles = disc(radius, rings)
    levels = grid_line(0.0, height, resolution, parts=parts)
    vertices = np.concatenate([np.column_stack([plane, np.full(len(plane), z)]) for z in levels])
    offsets = len(plane) * np.arange(len(levels) - 1)
    bottom = (triangles[None] + offsets[:, None, None]).reshape(-1, 3)
    prisms = np.concatenate([bottom, bottom + len(plane)], axis=1)
    # Alternate the ranking from level to level, so that the diagonals do not all wind the same way.
    level = np.repeat(np.arange(len(levels)), len(plane))
    within = np.tile(np.arange(len(plane)), len(levels))
    rank = np.where(within % 2 == level % 2, 0, 1) * len(vertices) + np.arange(len(vertices))
    return vertices, split_prisms(prisms, rank)[0]


def rod(length: float, radius: float, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """A round bar along +x; the origin is the lowest point of its end at x = 0. See `cylinder`."""
    vertices, tets = cylinder(radius, length, resolution)
    # (x, y, z) -> (z, x, y) is a rotation: orientation stays.
    return np.column_stack([vertices[:, 2], vertices[:, 0], vertices[:, 1] + radius]), tets


def ball(radius: float, resolution: float) -> tuple[np.ndarray, np.ndarray]:
    """A ball of a ``radius`` [m] that stands on the origin, with a vertex there and one at the top; ``resolution`` is
    the thickness of a shell, about the edge length [m]."""
    shells = max(2, math.ceil(radius / resolution - 1e-9))
    directions, faces = _icosahedron()
    number: dict[tuple[tuple[int, int], ...], int] = {}
    points: list[np.ndarray] = []

    def vertex(face: np.ndarray, weight: tuple[int, int, int]) -> int:
        # A point on an edge or corner shared by faces is the same vertex: key it by its non-zero weights.
        key = tuple(sorted((int(f), w) for f, w in zip(face, weight) if w))
        if key not in number:
            number[key] = len(points)
            along = sum((w * directions[f] for f, w in key), np.zeros(3))
            shell = sum(weight)
            points.append(along * (radius * shell / shells / max(float(np.linalg.norm(along)), 1e-300)))
        return number[key]

    tets: list[list[int]] = []
    octahedra: list[list[int]] = []
    for face in faces:
        for a, b, c in itertools.product(range(shells), repeat=3):
            room = shells - a - b - c
            if room >= 1:
                tets.append([vertex(face, w) for w in ((a, b, c), (a + 1, b, c), (a, b + 1, c), (a, b, c + 1))])
            if room >= 2:
                octahedra.append([vertex(face, w) for w in (
                    (a + 1, b, c), (a, b + 1, c + 1), (a, b + 1, c), (a + 1, b, c + 1), (a, b, c + 1),
                    (a + 1, b + 1, c))])
            if room >= 3:
                tets.append([vertex(face, w) for w in (
                    (a + 1, b + 1, c), (a + 1, b, c + 1), (a, b + 1, c + 1), (a + 1, b + 1, c + 1))])
    vertices = np.array(points)
    cut = np.array(tets + _cut_octahedra(vertices, np.array(octahedra)))
    flip = tet_volumes(vertices, cut) < 0.0
    cut[flip] = cut[flip][:, [1, 0, 2, 3]]
    return vertices + np.array([0.0, 0.0, radius]), cut


def _cut_octahedra(vertices: np.ndarray, octahedra: np.ndarray) -> list[list[int]]:
    """Four tetrahedra around the shortest of the three inner diagonals; corners come as opposite pairs."""
    out: list[list[int]] = []
    for corners in octahedra.reshape(-1, 3, 2):
        lengths = np.linalg.norm(vertices[corners[:, 0]] - vertices[corners[:, 1]], axis=1)
        # Rounded, so that equal lengths tie the same way on every machine.
        axis = int(np.argmin(np.round(lengths / lengths.max(), 9)))
        (p, q), (r, s), (t, u) = corners[axis], corners[(axis + 1) % 3], corners[(axis + 2) % 3]
        out += [[p, q, r, t], [p, q, t, s], [p, q, s, u], [p, q, u, r]]
    return out


def _icosahedron() -> tuple[np.ndarray, np.ndarray]:
    """Unit corners (12, 3) with one at each pole, and outward faces (20, 3)."""
    height, ring = 1.0 / math.sqrt(5.0), 2.0 / math.sqrt(5.0)
    upper = [(ring * math.cos(2 * math.pi * k / 5), ring * math.sin(2 * math.pi * k / 5), height) for k in range(5)]
    lower = [(ring * math.cos(2 * math.pi * (k + 0.5) / 5), ring * math.sin(2 * math.pi * (k + 0.5) / 5), -height)
             for k in range(5)]
    corners = np.array([(0.0, 0.0, 1.0), *upper, *lower, (0.0, 0.0, -1.0)])
    faces = []
    for k in range(5):
        n = (k + 1) % 5
        faces += [(0, 1 + k, 1 + n), (1 + k, 6 + k, 1 + n), (1 + n, 6 + k, 6 + n), (11, 6 + n, 6 + k)]
    return corners, np.array(faces)
