"""What a filling has of its scan, in numbers: box, volume, and the distance between the two; and what it stands on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from vsfsim.core.errors import MeshError
from vsfsim.core.solid import Solid, boundary_faces, tet_volumes
from vsfsim.physics.elements import gas
from vsfsim.physics.mesh.surface_distance import SurfaceDistance

if TYPE_CHECKING:
    from vsfsim.physics.mesh.repair import Surface  # imports trimesh, which a box does not need

BASE = 0.01
"""Height of the part of a scan whose nodes are its base face, over the scan's: below it the filling is cut flat [-]."""
FOOT = 0.05
"""Part of a scan's height that is held where it has no flat base to stand on [-]. A ball of 80 mm then stands on a foot
of 35 mm; with 2 % it was 22 mm, held by a dozen nodes, and a lumpy blob tipped over under 0.4 N."""
NARROW = 1 / 3
"""Part of the body's width or depth under which a base is no face to stand on, and a foot narrow enough for a warning
[-]."""
TOLD = 0.02
"""Relative difference above which a filling is said to depart from its scan [-]."""
REFUSED = 0.10
"""Relative difference above which a filling is refused [-]."""
_SAMPLES = 50  # of the body's volume along the longest edge of its box, where parts overlap
_POINTS = 20_000  # of a surface whose distance is measured, at most


@dataclass(frozen=True)
class Account:
    """A filling against its scan."""

    box: tuple[np.ndarray, np.ndarray]
    """Edges of the bounding box of scan and filling (3,), (3,) [m]."""
    volume: tuple[float, float]
    """Of scan and filling [m^3]."""
    distance: float
    """Largest distance of the scan's surface from the filling's [m]."""
    names: tuple[str, str] = ("scan", "filling")
    """Of the two that are compared, for people."""

    @property
    def off(self) -> dict[str, float]:
        """Relative differences [-]: of the volume, of the box, and the largest distance over the box's diagonal."""
        scan, filling = self.box
        return {"volume": self.volume[1] / self.volume[0] - 1.0, "box": float(np.abs(filling / scan - 1.0).max()),
                "distance": self.distance / float(np.linalg.norm(scan))}

    def sentence(self) -> str:
        """For people."""
        box = [" x ".join(f"{1e3 * e:.4g}" for e in edges) for edges in self.box]
        (scan, filling), off = self.names, self.off
        text = (f"{filling.capitalize()} against {scan}: box {box[1]} for {box[0]} mm, volume "
                f"{1e6 * self.volume[1]:.4g} for {1e6 * self.volume[0]:.4g} cm^3 ({100 * off['volume']:+.1f} %), "
                f"surfaces {1e3 * self.distance:.2g} mm apart at most.")
        told = [f"{name} {100 * abs(value):.1f} %" for name, value in off.items() if abs(value) > TOLD]
        return text + (f" The {filling} departs from the {scan} by more than {100 * TOLD:g} %: {', '.join(told)}."
                       if told else "")


def level(surface: Surface) -> Callable[[np.ndarray], np.ndarray]:
    """The level of points (k, 3) [m] that a filler asks, negative inside [m], with the base cut flat.

    A scan's base has the noise of the scanner, or a bottom that stood on a table and was never seen. What lies under
    1 % of the height is the section at that height, so that the body stands on a plane.
    """
    distance = SurfaceDistance(surface.vertices, surface.faces)
    base = float(surface.vertices[:, 2].min())
    section = np.array([-np.inf, -np.inf, base + BASE * float(surface.extents[2])])
    return lambda points: np.maximum(distance(np.maximum(points, section)), base - points[:, 2])


def scan_volume(surface: Surface) -> float:
    """Volume that a surface encloses [m^3]; parts that overlap count once."""
    exact = gas.volume(surface.vertices, surface.faces)
    if surface.watertight and not surface.overlap:
        return exact
    low, size = surface.vertices.min(axis=0), surface.extents
    step = float(size.max()) / _SAMPLES
    count = np.maximum(np.ceil(size / step).astype(int), 8)
    axes = [low[a] + size[a] * (np.arange(count[a]) + 0.5) / count[a] for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    within = SurfaceDistance(surface.vertices, surface.faces).inside(points)
    return float(within.mean() * np.prod(size))


def account(surface: Surface, volume: float, vertices: np.ndarray, tets: np.ndarray) -> Account:
    """Compare a filling with its scan.

    Args:
        surface: of the scan.
        volume: that it encloses, `scan_volume` [m^3].
        vertices: of the filling, in the frame of ``surface`` (n, 3) [m].
        tets: of the filling (m, 4).
    """
    return Account((surface.extents, np.ptp(vertices[np.unique(tets)], axis=0)),
                   (volume, float(tet_volumes(vertices, tets).sum())),
                   _apart(surface, SurfaceDistance(vertices, boundary_faces(tets)[0])))


def of_tip(surface: Surface, extents: np.ndarray, spacing: float, coefficients: np.ndarray,
           distance: Callable[[np.ndarray], np.ndarray]) -> Account:
    """Compare the distance grid of a probe with the surface of its file.

    Args:
        surface: of the file.
        extents: edges of the box of what the grid was made of (3,) [m].
        spacing: of the grid [m].
        coefficients: of the grid's cubic B-spline (nx, ny, nz) [m].
        distance: from the grid, of points (k, 3) [m].
    """
    phi = coefficients
    for axis in range(3):  # the spline at its nodes
        phi = ndimage.convolve1d(phi, [1 / 6, 2 / 3, 1 / 6], axis=axis)
    volume = spacing**3 * float(np.clip(0.5 - phi / spacing, 0.0, 1.0).sum())
    return Account((surface.extents, extents), (scan_volume(surface), volume),
                   _apart(surface, distance), ("file", "distance grid"))


def _apart(surface: Surface, distance: Callable[[np.ndarray], np.ndarray]) -> float:
    """Largest distance of what ``distance`` belongs to from a surface [m]."""
    corners = surface.vertices[surface.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    good = np.flatnonzero(size > 0.0)
    good = good[::max(1, len(good) // _POINTS)]
    # one point in the middle of each face, and one near its first corner
    points = np.concatenate([corners[good].mean(axis=1),
                             0.98 * corners[good, 0] + 0.01 * (corners[good, 1] + corners[good, 2])])
    if surface.overlap or not surface.watertight:
        # a face inside another part bounds nothing
        step = np.tile(1e-3 * np.linalg.norm(surface.extents) * normal[good] / size[good, None], (2, 1))
        test = SurfaceDistance(surface.vertices, surface.faces)
        outer = test.inside(points + step) != test.inside(points - step)
        points = points[outer] if outer.any() else points
    return float(np.abs(distance(points)).max())


def refuse(found: Account, what: str, remedy: str) -> None:
    """Refuse what is another body than its scan; ``what`` and ``remedy`` are the words before and after the account.

    Raises:
        MeshError: volume, box or distance differ by more than `REFUSED`.
    """
    if max(map(abs, found.off.values())) > REFUSED:
        raise MeshError(f"{what} so that it is within {100 * REFUSED:g} % of the {found.names[0]}. "
                        f"{found.sentence().split(' The ')[0]} {remedy} (e.g. in MeshLab).")


def scan_foot(solid: Solid) -> tuple[float, str]:
    """What ``fixed = "bottom"`` holds of a scan: its base face, or a foot where the base is round.

    Args:
        solid: the scan in its own frame.

    Returns:
        The height of the part that is held [m], and a sentence, with a warning where it is a narrow foot.
    """
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    height, whole = float(high[2] - low[2]), (high - low)[:2]
    for part in (BASE, FOOT):
        foot = np.ptp(solid.vertices[solid.vertices[:, 2] <= low[2] + part * height][:, :2], axis=0)
        if wide := bool((foot >= NARROW * whole).all()):
            break
    note = (f"fixed = \"bottom\" holds the scan's lowest {100 * part:g} %, {1e3 * part * height:.1f} mm: a foot of "
            f"{1e3 * foot[0]:.0f} x {1e3 * foot[1]:.0f} mm under a body of {1e3 * whole[0]:.0f} x "
            f"{1e3 * whole[1]:.0f} mm.")
    if not wide:
        box = ", ".join(f"{v:.3f}" for v in (*(low - 0.001), *(high[:2] + 0.001), low[2] + 0.25 * height))
        note += (f" On so narrow a foot the body may tip rather than be indented; fixed = [{box}] would hold its "
                 f"lowest quarter.")
    return part * height, note
