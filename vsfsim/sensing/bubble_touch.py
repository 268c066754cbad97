"""The bubble's part of a dataset's touch: what the solver found, as the fields of `vsfsim.data.records.Touch`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vsfsim.sensing.bubble import readout_of
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.membrane_fe import SensorError

if TYPE_CHECKING:
    from vsfsim.physics.bubble import BubbleModel


def touch_fields(model: BubbleModel, position: np.ndarray, force: np.ndarray, pressure: np.ndarray, mount_pose: np.ndarray, *,
                 converged: np.ndarray | None = None, camera: BubbleCamera | None = None, device: str = "cpu") -> dict[str, Any]:
    """Keyword arguments for a `Touch` made with a bubble: everything that a rigid probe does not have.

    Args:
        model: the bubble. position: its nodes, world (T, m, 3) [m]. force: contact force on each, world (T, m, 3) [N]. pressure: gauge (T,) [Pa].
        mount_pose: mount to world (T, 4, 4). converged: (T,) bool; the readings of other frames are NaN, and their pictures black. None for all.
        camera: also take pictures from inside. device: Warp device of the ray caster.

    Returns:
        pressure, rest_pressure, moment, node_position, node_force, node_rest, node_reference, node_triangles, and inside_depth and inside_rgb if there
        is a camera.

    Raises:
        SensorError: shapes that do not fit, or a converged frame that is not finite.
    """
    position, force, pressure, mount_pose = (np.asarray(x, np.float64) for x in (position, force, pressure, mount_pose))
    frames = len(position)
    good = np.ones(frames, bool) if converged is None else np.asarray(converged, bool)
    if mount_pose.shape != (frames, 4, 4) or pressure.shape != (frames,) or good.shape != (frames,) or force.shape != position.shape:
        raise SensorError(f"bubble: positions {position.shape}, forces {force.shape}, pressure {pressure.shape}, mount poses {mount_pose.shape} and converged {good.shape} "
                          "must be (T, m, 3) twice, (T,), (T, 4, 4) and (T,).")
    if not (np.isfinite(position[good]).all() and np.isfinite(force[good]).all() and np.isfinite(pressure[good]).all()):
        raise SensorError("bubble: a position, force or pressure of a converged frame is not finite; mark the frame as not converged.")
    readout = readout_of(model)
    nodes = len(readout.readout.points)

    def nan(*shape: int) -> np.ndarray:
        return np.full((frames, *shape), np.nan)

    out: dict[str, Any] = {"pressure": np.where(good, pressure, np.nan), "rest_pressure": float(model.pressure), "moment": nan(3),
                           "node_position": nan(nodes, 3), "node_force": nan(nodes, 3)}
    if good.any():
        seen = readout.frames(position[good], force[good], pressure[good], rest_pressure=model.pressure, origin=mount_pose[good, :3, 3])
        out["moment"][good], out["node_position"][good], out["node_force"][good] = seen.moment, seen.node_position, seen.node_force
    for name in ("node_position", "node_force"):
        out[name] = out[name].astype(np.float32)
    out["node_rest"] = readout.positions(model.mesh.points[None])[0]
    out["node_reference"] = readout.readout.points / model.spec.pre_stretch
    out["node_triangles"] = readout.readout.triangles
    if camera is not None:
        out["inside_depth"] = nan(camera.height, camera.width).astype(np.float32)
        out["inside_rgb"] = np.zeros((frames, camera.height, camera.width, 3), np.uint8)
        if good.any():
            local = np.einsum("tni,tij->tnj", position[good] - mount_pose[good, None, :3, 3], mount_pose[good, :3, :3])
            inside = look_inside(local, model.mesh.faces, model.flat, camera, device=device)
            out["inside_depth"][good], out["inside_rgb"][good] = inside.depth, inside.rgb
    return out
