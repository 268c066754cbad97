"""Contact forces of a recorded Punyo, by every estimator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import VsfsimError
from vsfsim.core.text_table import text_table
from vsfsim.physics.mesh.formats import parse
from vsfsim.sensing.bubble_touch import estimate_forces
from vsfsim.sensing.dense_force import METHODS
from vsfsim.sensing.recorded_punyo import read_sequence


def measure(folder: Path, mesh: Path, *, frames: Sequence[int], flat: Path | None = None, tilt: float = 25.0,
            stiffness: float = 680.0, rest_pressure: float = 7820.0) -> list[dict[str, Any]]:
    """A row for every frame.

    Args:
        folder: as `vsfsim.sensing.recorded_punyo` reads it. mesh: of the free dome (VTK, PLY, OBJ) [m]. frames: their
        numbers. flat: the same mesh before it was blown up; without it method `membrane` is left out. tilt: by which
        the mesh's frame is turned about y to the camera's [deg]. stiffness: E h [N/m]. rest_pressure: gauge [Pa].

    Raises:
        VsfsimError: a file cannot be read or does not fit.
    """
    vertices, faces = _read(mesh)
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    vertices = vertices @ np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]]).T
    found = read_sequence(folder, vertices, faces, rest_pressure=rest_pressure, frames=frames,
                          flat=None if flat is None else _read(flat)[0][:, :2])
    touch = found.touch
    assert touch.node_position is not None and touch.node_rest is not None and touch.pressure is not None
    moved = np.linalg.norm(touch.node_position - touch.node_rest, axis=2)
    rows: list[dict[str, Any]] = [
        {"frame": k, "pressure_change_Pa": float(touch.pressure[t] - rest_pressure), "seen": int(found.seen[t].sum()),
         "largest_displacement_mm": 1e3 * float(moved[t].max())} for t, k in enumerate(found.frames)]
    for method in METHODS:
        if method == "membrane" and flat is None:
            continue
        force = estimate_forces(touch, stiffness=stiffness, method=method).force
        size = np.linalg.norm(force, axis=2)
        middle = np.einsum("tn,nc->tc", size, touch.node_rest) / np.maximum(size.sum(axis=1), 1e-12)[:, None]
        for t, row in enumerate(rows):
            row[method] = {"force_N": float(np.linalg.norm(force[t].sum(axis=0))), "from_the_dent_mm": 1e3 * float(
                np.linalg.norm(middle[t] - touch.node_rest[int(moved[t].argmax())]))}
    return rows


def text(rows: Sequence[dict[str, Any]]) -> str:
    """The table."""
    methods = [m for m in METHODS if m in rows[0]]
    head = ("frame", "pressure [Pa]", "nodes seen", "dent [mm]", *(f"{m} [N] (off [mm])" for m in methods))
    return text_table(head, [(str(r["frame"]), f"{r['pressure_change_Pa']:.0f}", str(r["seen"]),
                              f"{r['largest_displacement_mm']:.2f}",
                              *(f"{r[m]['force_N']:.2f} ({r[m]['from_the_dent_mm']:.1f})" for m in methods))
                             for r in rows], right=True)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) [m] and triangles (M, 3)."""
    if path.suffix != ".vtk":
        try:
            found = parse(path.read_bytes(), path)
        except OSError as error:
            raise VsfsimError(f"{path} cannot be read: {error.strerror}.") from error
        return found.vertices, found.faces
    if not path.is_file():
        raise VsfsimError(f"{path} does not exist.")
    import pyvista

    mesh = pyvista.read(path)
    return np.asarray(mesh.points, float), np.asarray(mesh.cells_dict[int(pyvista.CellType.TRIANGLE)])
