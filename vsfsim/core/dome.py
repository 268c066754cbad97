"""The front of a soft sensor in a dataset: a surface mesh in the mount's frame. NumPy and SciPy, so that a method needs
no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError, unknown_key

_DIGITS = 9  # of a stored coordinate in metres: a nanometre
_CELLS = 8  # along each side, in which triangles are looked up


@dataclass(frozen=True)
class Dome:
    """The free, untouched skin of a bubble, a height over its rim plane.

    The origin is in the middle of the rim, +z points out of the dome and into the object. As a "probe" of a dataset
    it is what touched the object; ``node_position`` of a touch gives the dented skin.
    """

    vertices: tuple[tuple[float, float, float], ...]
    """Of the read-out mesh, N of (x, y, z) [m]."""
    triangles: tuple[tuple[int, int, int], ...]
    """Wound outwards, F of three vertices."""

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

    @cached_property
    def base_area(self) -> float:
        """Inside the rim [m^2]: openvsf's A_base."""
        a, b, c = (self.points[self.faces[:, k], :2] for k in range(3))
        return float(0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).sum())

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

    def table(self) -> dict[str, Any]:
        """As JSON values; `read_dome` takes them back."""
        return {"vertices": [list(v) for v in self.vertices], "triangles": [list(t) for t in self.triangles]}


def read_dome(table: Any, where: str) -> Dome:
    """The dome of `Dome.table`.

    Raises:
        SceneError: a key is missing or unknown, or a list has another form.
    """
    keys = ("vertices", "triangles")
    if not isinstance(table, Mapping):
        raise SceneError(f"{where}: dome is {table!r}; it must be a table.")
    for key in table:
        if key not in keys:
            raise SceneError(unknown_key(f"{where} dome", key, keys))
    try:
        vertices, triangles = np.array(table["vertices"], float), np.array(table["triangles"], int)
    except (KeyError, TypeError, ValueError) as error:
        raise SceneError(f"{where}: the dome cannot be read ({error!r}); it is a table of {', '.join(keys)}, as "
                         f"`vsfsim generate` writes it.") from error
    shaped = all(array.ndim == 2 and array.shape[1] == 3 for array in (vertices, triangles)) and len(triangles) > 0
    if not shaped or not np.isfinite(vertices).all() or not 0 <= triangles.min() <= triangles.max() < len(vertices):
        raise SceneError(f"{where}: the dome has vertices {vertices.shape} and triangles {triangles.shape}; give "
                         f"finite (N, 3) in metres and (F, 3) that name them.")
    return Dome.of(vertices, triangles)
