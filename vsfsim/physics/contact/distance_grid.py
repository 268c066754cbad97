"""Signed distance of a triangle mesh, baked into a grid once and then smooth: a cubic B-spline.

    phi(x) = sum_ijk c_ijk B(x/h - i) B(y/h - j) B(z/h - k),     phi(x_ijk) = signed distance at node (i, j, k)

B is the cardinal cubic B-spline, so phi is C2: gap, gradient and Hessian are derivatives of one function. The
coefficients make phi interpolate the nodes (Unser 1999, "Splines: a perfect fit for signal and image processing"):
where the distance is smooth the error falls as h^4. Near an edge or a medial surface, where it has a kink, phi rounds
it over about one spacing: error O(h), 0.1 h at an edge of 90 degrees.

Spacing: the finer of LONGEST cells along the longest edge of the bounding box and SHORTEST along the shortest, but
never more than MAX_NODES nodes (16 MB of doubles). Distance: to the exact triangles, in double. Sign: generalised
winding number (Jacobson et al. 2013; Barill et al. 2018), so that parts that overlap are one solid.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import MeshFile
from vsfsim.physics.mesh.surface_distance import SurfaceDistance

LONGEST, SHORTEST = 64, 20  # cells along the longest and the shortest edge of the bounding box
MAX_NODES = 2_000_000
PAD = 4  # cells of distance kept around the bounding box
# cells beyond, for the spline's end conditions alone: what they do wrong fades by 0.27 a cell, to 1e-5 at the body
_RIM = 4


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """A baked mesh, in the probe's frame, whose origin is the centre of the bounding box; equal to itself alone."""

    coefficients: np.ndarray
    """Of the spline (nx, ny, nz) [m]."""
    origin: np.ndarray
    """Node (0, 0, 0) of the grid (3,) [m]."""
    spacing: float
    """Of the grid [m]."""
    vertices: np.ndarray
    """Corners of the mesh (n, 3) [m]."""
    faces: np.ndarray
    """Triangles of the mesh (f, 3)."""
    notes: tuple[str, ...]
    """What was repaired or decided, for people."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """phi (...,) [m] at ``points`` (..., 3) [m]; beyond the grid a lower bound of the distance, see `domain`."""
        x = np.asarray(points, float)
        low, high = self.domain()
        inside = np.clip(x, low, high)
        at = (inside - self.origin) / self.spacing
        # SciPy refuses a single point without an axis of points
        phi = ndimage.map_coordinates(self.coefficients, at.reshape(-1, 3).T, order=3,
                                      prefilter=False).reshape(at.shape[:-1])
        away = np.linalg.norm(x - inside, axis=-1)
        return np.where(away > 0.0, np.maximum(phi - away, away), phi)

    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners (3,), (3,) [m] of the box in which phi is the spline.

        Beyond it the larger of two lower bounds stands for the distance: phi at the nearest point of the box less the
        way there, and that way. Both are right in sign, so a step of that length never jumps over the body.
        """
        return self.origin + self.spacing, self.origin + self.spacing * (np.array(self.coefficients.shape) - 2.0)


def spacing_rule(size: np.ndarray) -> float:
    """Spacing [m] for a bounding box of edges ``size`` (3,) [m]; see the head of this file."""
    wanted = min(float(size.max()) / LONGEST, float(size.min()) / SHORTEST)
    while np.prod(np.ceil(size / wanted) + 2 * PAD + 3) > MAX_NODES:
        wanted *= 1.02
    return wanted


def baked(shape: MeshFile) -> DistanceGrid:
    """The grid of a mesh file, made now or kept in this process.

    Raises:
        MeshError: as `vsfsim.physics.mesh.repair.read_surface`, or a surface that cannot be closed.
    """
    return _baked(shape, shape.content())


@functools.lru_cache(maxsize=16)
def _baked(shape: MeshFile, content: bytes) -> DistanceGrid:
    from vsfsim.physics.elements import gas
    from vsfsim.physics.mesh import account, repair

    surface = repair.read_surface(shape)
    if gas.volume(surface.vertices, surface.faces) < 1e-4 * float(np.prod(surface.extents)):
        raise MeshError(f"mesh file '{shape.path}' encloses no volume: it is an open sheet; a probe is a solid. "
                        f"Close it or give it thickness.")
    grid = bake(surface.vertices + surface.centre, surface.faces, notes=surface.notes)
    found = account.of_tip(surface, np.ptp(grid.vertices, axis=0), grid.spacing, grid.coefficients, grid.distance)
    account.refuse(found, f"mesh file '{shape.path}' could not be taken as a probe", "Repair the mesh by hand")
    return replace(grid, notes=(*grid.notes, found.sentence()))


def bake(vertices: np.ndarray, faces: np.ndarray, *, spacing: float | None = None,
         notes: tuple[str, ...] = ()) -> DistanceGrid:
    """The grid of a closed surface.

    Args:
        vertices: corners (n, 3) [m].
        faces: triangles (f, 3), wound outwards.
        spacing: of the grid [m], or None for the rule.
        notes: put before the notes made here.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    centre = 0.5 * (low + high)
    vertices, low, high = vertices - centre, low - centre, high - centre
    h = spacing_rule(high - low) if spacing is None else spacing
    cells = np.ceil((high - low) / h).astype(int) + 2 * (PAD + 1)
    nodes = cells + 1 + 2 * _RIM
    first = 0.5 * (low + high) - 0.5 * h * (nodes - 1)
    axes = [first[c] + h * np.arange(nodes[c]) for c in range(3)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    distance = SurfaceDistance(vertices, faces)(at).reshape(nodes)
    still = np.abs(centre).max() < 1e-6 * (high - low).max()
    moved = "" if still else f" moved by ({', '.join(f'{-c:.4g}' for c in centre)}) m so that"
    note = (f"Probe mesh: {len(faces)} triangles, {' x '.join(f'{1e3 * e:.4g}' for e in high - low)} mm,{moved} "
            f"the centre of its bounding box is the probe's origin; distance grid of {1e3 * h:.3g} mm.")
    coefficients = ndimage.spline_filter(distance, order=3, mode="mirror")[(slice(_RIM, -_RIM),) * 3]
    return DistanceGrid(np.ascontiguousarray(coefficients), first + _RIM * h, float(h), vertices, faces, (*notes, note))
