"""What a filling has of its scan, in numbers: box, volume, cavities, parts, and the distance between the two."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vsfsim.core.errors import MeshError
from vsfsim.core.solid import boundary_faces, tet_volumes
from vsfsim.physics.mesh.foot import BASE
from vsfsim.physics.mesh.manifold import body_of_each_tet, shells
from vsfsim.physics.mesh.repair import Surface, signed_volume
from vsfsim.physics.mesh.surface_distance import SurfaceDistance

TOLD = 0.02
"""Relative difference above which a filling is said to depart from its scan [-]."""
REFUSED = 0.10
"""Relative difference above which a filling is refused [-]."""
_SAMPLES = 80  # of the body's volume along the longest edge of its box, where parts overlap
_POINTS = 20_000  # of a surface whose distance is measured, at most


@dataclass(frozen=True)
class Account:
    """A filling against its scan."""

    box: tuple[np.ndarray, np.ndarray]
    """Edges of the bounding box of scan and filling (3,), (3,) [m]."""
    volume: tuple[float, float]
    """Of scan and filling [m^3]."""
    cavities: tuple[int, int]
    """Of scan and filling."""
    parts: tuple[int, int]
    """Of scan and filling; parts of a scan that overlap make one of the filling."""
    distance: tuple[float, float]
    """From the scan's surface to the filling's: root mean square and largest [m]."""

    @property
    def off(self) -> dict[str, float]:
        """Relative differences [-]: of the volume, of the box, and the largest distance over the box's diagonal."""
        scan, filling = self.box
        return {"volume": self.volume[1] / self.volume[0] - 1.0,
                "box": float(np.abs(filling / scan - 1.0).max()),
                "distance": self.distance[1] / float(np.linalg.norm(scan))}

    @property
    def worst(self) -> float:
        """The largest of the relative differences [-]."""
        return max(abs(v) for v in self.off.values())

    def sentence(self) -> str:
        """For people."""
        box = [" x ".join(f"{1e3 * e:.4g}" for e in edges) for edges in self.box]
        off = self.off
        text = (f"Filling against scan: box {box[1]} for {box[0]} mm, volume {1e6 * self.volume[1]:.4g} for "
                f"{1e6 * self.volume[0]:.4g} cm^3 ({100 * off['volume']:+.1f} %), cavities {self.cavities[1]} for "
                f"{self.cavities[0]}, parts {self.parts[1]} for {self.parts[0]}, surfaces {1e3 * self.distance[0]:.2g} "
                f"mm apart (rms), {1e3 * self.distance[1]:.2g} mm at most.")
        told = ", ".join(f"{name} {100 * abs(value):.1f} %" for name, value in off.items() if abs(value) > TOLD)
        if self.cavities[0] != self.cavities[1]:
            told += f"{', ' if told else ''}cavities {self.cavities[1]} for {self.cavities[0]}"
        return text + (f" The filling departs from the scan by more than {100 * TOLD:g} %: {told}; a finer resolution "
                       "brings them together." if told else "")


def inside(surface: Surface) -> Callable[[np.ndarray], np.ndarray]:
    """The test of points (k, 3) [m] that a filler asks, with the base cut flat.

    A scan's base has the noise of the scanner, or a bottom that stood on a table and was never seen. What lies under
    1 % of the height is the section at that height, so that the body stands on a plane.
    """
    distance = SurfaceDistance(surface.vertices, surface.faces)
    base = float(surface.vertices[:, 2].min())
    section = base + BASE * float(surface.extents[2])

    def test(points: np.ndarray) -> np.ndarray:
        lifted = points.copy()
        lifted[:, 2] = np.maximum(points[:, 2], section)
        return (distance(lifted) < 0.0) & (points[:, 2] >= base)

    return test


def scan_volume(surface: Surface) -> float:
    """Volume that a surface encloses [m^3]; parts that overlap count once."""
    exact = signed_volume(surface.vertices, surface.faces)
    if surface.watertight and not surface.overlap:
        return exact
    low, size = surface.vertices.min(axis=0), surface.extents
    step = float(size.max()) / _SAMPLES
    count = np.maximum(np.ceil(size / step).astype(int), 8)
    axes = [low[a] + size[a] * (np.arange(count[a]) + 0.5) / count[a] for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    within = SurfaceDistance(surface.vertices, surface.faces)(points) < 0.0
    return float(within.mean() * np.prod(size))


def account(surface: Surface, volume: float, vertices: np.ndarray, tets: np.ndarray) -> Account:
    """Compare a filling with its scan.

    Args:
        surface: of the scan.
        volume: that it encloses, `scan_volume` [m^3].
        vertices: of the filling, in the frame of ``surface`` (n, 3) [m].
        tets: of the filling (m, 4).
    """
    faces, _ = boundary_faces(tets)
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
        outer = (test(points + step) < 0.0) != (test(points - step) < 0.0)
        points = points[outer] if outer.any() else points
    away = np.abs(SurfaceDistance(vertices, faces)(points))
    hollow = sum(signed_volume(vertices, shell) < 0.0 for shell in shells(faces))
    return Account((surface.extents, np.ptp(vertices[np.unique(tets)], axis=0)),
                   (volume, float(tet_volumes(vertices, tets).sum())), (surface.cavities, hollow),
                   (surface.parts, int(body_of_each_tet(tets).max()) + 1),
                   (float(np.sqrt((away**2).mean())), float(away.max())))


def refuse(found: Account, path: Path, resolution: float) -> None:
    """Refuse a filling that is another body than its scan.

    Raises:
        MeshError: volume, box or distance differ by more than `REFUSED`.
    """
    if found.worst <= REFUSED:
        return
    raise MeshError(f"mesh file '{path}' could not be filled with tetrahedra of {resolution:g} m so that the body is "
                    f"within {100 * REFUSED:g} % of the scan. {found.sentence().split(' The filling departs')[0]} Use "
                    "a finer resolution ([object] resolution), or repair the mesh by hand (e.g. in MeshLab).")
