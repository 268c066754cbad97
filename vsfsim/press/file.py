"""Every number of a press in one file: meshes, displacements and contact forces of all frames."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from vsfsim.data.disk import write_atomic
from vsfsim.press.probe import PressResult

UNITS = {
    "points": "nodes at rest, world (n, 3) [m]",
         "tets": "quadratic tetrahedra (m, 10): corners, then the edges 01 12 20 03 13 23",
    "faces": "boundary triangles (f, 6): corners, then the edges 01 12 20",
         "surface_nodes": "nodes on the boundary (s,)",
    "displacement": "of every node (T, n, 3) [m]", "contact_force": "on every surface node (T, s, 3) [N]",
         "contact_pressure": "mean over every boundary triangle (T, f) [Pa]",
    "young_modulus": "mean of every tetrahedron (m,) [Pa]", "poses": "rigid bodies to world (T, K, 4, 4) [m]",
         "depth": "past first contact (T,) [m]",
    "force": "on the probe and its parts (T, 3) [N]", "reaction": "of the supports (T, 3) [N]", "converged": "(T,)",
         "residual": "(T,) [-]", "iterations": "(T,)",
    "force_balance": "(T,) [-]", "min_det_f": "(T,) [-]", "energy": "(T,) [J]", "penetration": "(T,) [m]",
}
"""Arrays of the file, with shape and unit; stored in it as ``units``, a JSON object."""


def save(result: PressResult, path: Path) -> None:
    """Write ``path`` (.npz); the result must have kept its state.

    Raises:
        DatasetError: it cannot be written.
    """
    from vsfsim.press.picture import face_pressure

    state = result.state
    assert state is not None
    mesh = state.model.mesh
    arrays = {
        "points": mesh.points, "tets": mesh.tets, "faces": mesh.faces, "surface_nodes": mesh.surface_nodes(),
              "displacement": state.displacement,
        "contact_force": state.surface_force,
              "contact_pressure": np.stack([face_pressure(mesh, f) for f in state.surface_force]),
        "young_modulus": state.model.young_modulus.mean(axis=1), "poses": state.poses,
        **{key: getattr(result, key) for key in ("depth", "force", "reaction", "converged", "residual", "iterations")},
              **result.audit}
    assert set(arrays) == set(UNITS)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, units=np.array(json.dumps(UNITS)), **arrays)
    write_atomic(path, buffer.getvalue())
