"""A bubble's fields of `vsfsim.data.records.Touch` from the solver's state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vsfsim.sensing.bubble import readout_of
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside

if TYPE_CHECKING:
    from vsfsim.physics.bubble.sensor import BubbleModel


def touch_fields(model: BubbleModel, position: np.ndarray, force: np.ndarray, pressure: np.ndarray,
                 mount_pose: np.ndarray, *, converged: np.ndarray, camera: BubbleCamera | None = None,
                 device: str = "cpu") -> dict[str, Any]:
    """Keyword arguments for a `Touch` by a bubble: the fields that a rigid probe does not have.

    Args:
        model: the bubble; ``model.spec.fine`` says whether the solver's own mesh is recorded, too.
        position: of its nodes, world (T, m, 3) [m].
        force: contact force on each node, world (T, m, 3) [N].
        pressure: gauge (T,) [Pa].
        mount_pose: mount to world (T, 4, 4) [m].
        converged: (T,) bool; the readings of other frames are NaN, and their pictures black.
        camera: takes pictures from inside; None for none.
        device: Warp device of the ray caster.

    Returns:
        pressure, rest_pressure, moment, node_position, node_force, node_rest, node_reference, node_triangles;
        fine_position, fine_force, fine_rest and fine_triangles with ``model.spec.fine``; inside_depth and inside_rgb
        with a camera.
    """
    frames, good, readout = len(position), converged, readout_of(model)
    nodes = len(readout.readout.flat)

    def nan(*shape: int) -> np.ndarray:
        return np.full((frames, *shape), np.nan)

    out: dict[str, Any] = {"pressure": np.where(good, pressure, np.nan),
                           "rest_pressure": float(model.spec.gauge_pressure), "moment": nan(3),
                           "node_position": nan(nodes, 3), "node_force": nan(nodes, 3)}
    if good.any():
        out["moment"][good] = np.cross(
            position[good] - mount_pose[good, None, :3, 3], force[good]).sum(axis=1)
        out["node_position"][good] = readout.positions(position[good])
        out["node_force"][good] = readout.forces(position[good], force[good])
    for name in ("node_position", "node_force"):
        out[name] = out[name].astype(np.float32)
    out["node_rest"] = readout.positions(model.mesh.points[None])[0]
    out["node_reference"] = readout.readout.flat / model.spec.pre_stretch
    out["node_triangles"] = readout.readout.faces.astype(np.int64)
    if model.spec.fine:
        for name, values in (("fine_position", position), ("fine_force", force)):
            out[name] = np.where(good[:, None, None], values, np.nan).astype(np.float32)
        out["fine_rest"], out["fine_triangles"] = model.mesh.points, model.mesh.faces.astype(np.int64)
    if camera is not None:
        out["inside_depth"] = nan(camera.height, camera.width).astype(np.float32)
        out["inside_rgb"] = np.zeros((frames, camera.height, camera.width, 3), np.uint8)
        if good.any():
            local = np.einsum("tni,tij->tnj", position[good] - mount_pose[good, None, :3, 3], mount_pose[good, :3, :3])
            out["inside_depth"][good], out["inside_rgb"][good] = look_inside(local, model.mesh.faces, model.flat,
                                                                             camera, device=device)
    return out
