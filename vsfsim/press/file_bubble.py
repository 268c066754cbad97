"""Every number of a bubble's press in one file: meshes, node positions and contact forces of all frames, pressure and
wrench."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from vsfsim.data.disk import write_atomic
from vsfsim.press.bubble import BubblePress

UNITS = {
    "node_position": "read-out mesh, mount frame (T, 390, 3) [m]",
         "node_force": "contact force handed to its nodes, mount frame (T, 390, 3) [N]",
    "free_node_position": "read-out mesh of the free dome (390, 3) [m]",
         "faces": "triangles of the read-out mesh, wound outwards (714, 3)", "rim": "its clamped nodes in order (64,)",
    "fine_position": "fine mesh, mount frame (T, n, 3) [m]",
         "fine_force": "contact force on its nodes, mount frame (T, n, 3) [N]",
    "free_fine_position": "fine mesh of the free dome (n, 3) [m]", "fine_faces": "its triangles (f, 3)",
         "fine_rim": "its clamped nodes in order (r,)",
    "mount_pose": "mount to world (T, 4, 4) [m]",
         "wrench": "of the contact at the mount's origin, mount frame: force, moment (T, 6) [N, N m]",
    "pressure": "gauge (T,) [Pa]", "pressure_change": "since the free dome (T,) [Pa]",
         "volume": "of the gas (T,) [m^3]", "depth": "past first contact (T,) [m]",
    "force": "on the sensor, world (T, 3) [N]", "reaction": "of the mount, world (T, 3) [N]", "converged": "(T,)",
         "residual": "(T,) [-]", "iterations": "(T,)",
    "force_balance": "(T,) [-]", "min_det_f": "(T,) [-], 1: incompressible",
         "energy": "membrane and gas, since the free dome's gas (T,) [J]", "penetration": "(T,) [m]",
}
"""Arrays of the file, with shape and unit; stored in it as ``units``, a JSON object."""


def save(result: BubblePress, path: Path) -> None:
    """Write ``path`` (.npz); the result must have kept its state.

    Raises:
        DatasetError: it cannot be written.
    """
    state = result.state
    assert state is not None
    mesh, seen = state.model.mesh, state.model.read_out
    arrays = {
        "node_position": state.read_out_position(), "node_force": state.read_out_force(),
              "free_node_position": seen.positions(mesh.points), "faces": seen.faces, "rim": seen.rim,
        "fine_position": state.node_position, "fine_force": state.node_force, "free_fine_position": mesh.points,
              "fine_faces": mesh.faces, "fine_rim": mesh.rim,
        "mount_pose": state.mount,
        **{key: getattr(result, key) for key in ("wrench", "pressure", "pressure_change", "volume", "depth", "force",
                                                 "reaction", "converged", "residual", "iterations")},
        **result.audit}
    assert set(arrays) == set(UNITS)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, units=np.array(json.dumps(UNITS)), **arrays)
    write_atomic(path, buffer.getvalue())
