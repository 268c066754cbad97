"""The front of a soft sensor in a dataset: a surface mesh in the mount's frame. NumPy and SciPy, so that a method needs
no simulator."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from vsfsim.core.table import Count, Vector

_DIGITS = 9  # of a stored coordinate in metres: a nanometre
_CELLS = 8  # along each side, in which triangles are looked up


@dataclass(frozen=True)
class Dome:
    """The free, untouched skin of a bubble, a height over its rim plane.

    The origin is in the middle of the rim, +z points out of the dome and into the object. As a "probe" of a dataset
    it is what touched the object; ``node_position`` of a touch gives the dented skin.
    """

    vertices: tuple[Vector, ...]
    """Of the read-out mesh, N of (x, y, z) [m]."""
    triangles: tuple[tuple[Count, Count, Count], ...]
    """Wound outwards, F of three vertices."""

    def __post_init__(self) -> None:
        if not self.triangles or max(map(max, self.triangles)) >= len(self.vertices):
            raise ValueError(f"it has {len(self.vertices)} vertices and {len(self.triangles)} triangles; give "
                             f"triangles, of three vertices each that are there")

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray) -> Dome:
        """From arrays (N, 3) [m] and (F, 3); coordinates are rounded to nanometres, as they are stored."""
        rounded = np.round(np.asarray(vertices, float), _DIGITS) + 0.0
        return cls(tuple(map(tuple, rounded.tolist())), tuple(map(tuple, np.asarray(triangles, int).tolist())))

    def __repr__(self) -> str:
        # A message is too short for hundreds of vertices; the hash distinguishes two domes.
        return (f"Dome({len(self.vertices)} vertices, {1e3 * self.height:.1f} mm high, "
                f"{hash((self.vertices, self.triangles)) & 0xFFFFFFFF:08x})")

    @cached_property
    def points(self) -> np.ndarray:
        """Vertices as an array (N, 3) [m]."""
        out = np.array(self.vertices)
        out.flags.writeable = False
        return out

    @cached_property
    def faces(self) -> np.ndarray:
        """Triangles as an array (F, 3)."""
        out = np.array(self.triangles)
        out.flags.writeable = False
        return out

    @property
    def height(self) -> float:
        """Of the apex over the rim plane [m]."""
        return float(self.points[:, 2].max())

    @property
    def reach(self) -> float:
        """Of the farthest vertex from the origin [m]."""
        return float(np.linalg.norm(self.points, axis=1).max())

    def heights(self, at: np.ndarray) -> np.ndarray:
        """Height of the skin over the rim plane (k,) [m] at places (k, 2) [m] of that plane; -inf outside the rim."""
        out = np.full(len(at), -np.inf)
        low, high = self.points[:, :2].min(axis=0), self.points[:, :2].max(axis=0)
        near = np.flatnonzero(((at >= low) & (at <= high)).all(axis=1))
        cell = (np.minimum((at[near] - low) / (high - low) * _CELLS, _CELLS - 1).astype(int) * [_CELLS, 1]).sum(axis=1)
        corners, z = self.points[self.faces][:, :, :2], self.points[self.faces][:, :, 2]
        inverse = self._inverses
        # triangles whose box meets a cell
        first, last = ((corners.min(axis=1) - low) / (high - low) * _CELLS
                       - 1e-6).astype(int), ((corners.max(axis=1) - low) / (high - low) * _CELLS + 1e-6).astype(int)
        for c in np.unique(cell):
            i, j = divmod(int(c), _CELLS)
            mine = np.flatnonzero((first[:, 0] <= i) & (i <= last[:, 0]) & (first[:, 1] <= j) & (j <= last[:, 1]))
            part = near[cell == c]
            if not len(mine):
                continue
            two = np.einsum("mij,kmj->kmi", inverse[mine], at[part, None] - corners[None, mine, 0])
            weight = np.concatenate([1.0 - two.sum(axis=2, keepdims=True), two], axis=2)
            inside = weight.min(axis=2)
            best = inside.argmax(axis=1)
            rows = np.arange(len(part))
            held = inside[rows, best] >= -1e-9
            out[part[held]] = np.einsum("kc,kc->k", weight[rows, best], z[mine[best]])[held]
        return out

    def to_vertices(self, points: np.ndarray) -> np.ndarray:
        """Distance of ``points`` (k, 3) [m] to the nearest vertex (k,) [m]."""
        return self._tree.query(points)[0]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree  # inside: see core/rotation.py

        return cKDTree(self.points)

    @cached_property
    def _inverses(self) -> np.ndarray:
        """From places of the rim plane to coordinates along two edges of each triangle (F, 2, 2) [1/m]."""
        corners = self.points[self.faces][:, :, :2]
        return np.linalg.inv(np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2))
