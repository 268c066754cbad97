"""A bubble's fields of `vsfsim.data.records.Touch` from the solver's state, and estimated forces from these fields."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vsfsim.data.records import Touch
from vsfsim.sensing.bubble import readout_of, wrench
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.dense_force import BubbleCalibration, DenseForce, DenseForceEstimator, EstimatorOptions
from vsfsim.sensing.membrane_fe import SensorError

if TYPE_CHECKING:
    from vsfsim.physics.bubble.sensor import BubbleModel


def touch_fields(model: BubbleModel, position: np.ndarray, force: np.ndarray, pressure: np.ndarray,
                 mount_pose: np.ndarray, *, converged: np.ndarray | None = None, camera: BubbleCamera | None = None,
                 device: str = "cpu") -> dict[str, Any]:
    """Keyword arguments for a `Touch` by a bubble: the fields that a rigid probe does not have.

    Args:
        model: the bubble; ``model.spec.fine`` says whether the solver's own mesh is recorded, too.
        position: of its nodes, world (T, m, 3) [m].
        force: contact force on each node, world (T, m, 3) [N].
        pressure: gauge (T,) [Pa].
        mount_pose: mount to world (T, 4, 4) [m].
        converged: (T,) bool, None for all; the readings of other frames are NaN, and their pictures black.
        camera: takes pictures from inside; None for none.
        device: Warp device of the ray caster.

    Returns:
        pressure, rest_pressure, moment, node_position, node_force, node_rest, node_reference, node_triangles;
        fine_position, fine_force, fine_rest and fine_triangles with ``model.spec.fine``; inside_depth and inside_rgb
        with a camera.
    """
    position, force, pressure, mount_pose = (np.asarray(x, np.float64) for x in (position, force, pressure, mount_pose))
    frames = len(position)
    good = np.ones(frames, bool) if converged is None else np.asarray(converged, bool)
    readout = readout_of(model)
    nodes = len(readout.readout.points)

    def nan(*shape: int) -> np.ndarray:
        return np.full((frames, *shape), np.nan)

    out: dict[str, Any] = {"pressure": np.where(good, pressure, np.nan), "rest_pressure": float(model.pressure),
                           "moment": nan(3), "node_position": nan(nodes, 3),
                           "node_force": nan(nodes, 3)}
    if good.any():
        out["moment"][good] = wrench(position[good], force[good], origin=mount_pose[good, :3, 3])[1]
        out["node_position"][good] = readout.positions(position[good])
        out["node_force"][good] = readout.forces(position[good], force[good])
    for name in ("node_position", "node_force"):
        out[name] = out[name].astype(np.float32)
    out["node_rest"] = readout.positions(model.mesh.points[None])[0]
    out["node_reference"] = readout.readout.points / model.spec.pre_stretch
    out["node_triangles"] = readout.readout.triangles
    if model.spec.fine:
        for name, values in (("fine_position", position), ("fine_force", force)):
            out[name] = np.where(good[:, None, None], values, np.nan).astype(np.float32)
        out["fine_rest"], out["fine_triangles"] = model.mesh.points, model.mesh.faces.astype(np.int64)
    if camera is not None:
        out["inside_depth"] = nan(camera.height, camera.width).astype(np.float32)
        out["inside_rgb"] = np.zeros((frames, camera.height, camera.width, 3), np.uint8)
        if good.any():
            local = np.einsum("tni,tij->tnj", position[good] - mount_pose[good, None, :3, 3], mount_pose[good, :3, :3])
            inside = look_inside(local, model.mesh.faces, model.flat, camera, device=device)
            out["inside_depth"][good], out["inside_rgb"][good] = inside.depth, inside.rgb
    return out


def aligned_nodes(position: np.ndarray, mount_pose: np.ndarray, time: np.ndarray, lag: float) -> np.ndarray:
    """Node positions at the times of the frames from images that show the sensor ``lag`` earlier.

    The image that shows a frame is taken ``lag`` after it, so this works on recorded touches, not while touching. The
    mount's pose has no lag and the shape of the skin is aligned in the mount's frame, linear between images.

    Args:
        position: measured nodes, world (T, N, 3) [m]; NaN where there is no image.
        mount_pose: mount to world at the frames (T, 4, 4) [m].
        time: of the frames (T,) [s], increasing.
        lag: delay of the images against the pressure [s], at least 0.

    Returns:
        World (T, N, 3) [m]. NaN where the touch ends before the image is taken, and where there was none.

    Raises:
        SensorError: the lag is negative, or the shapes do not fit.
    """
    position, time = np.asarray(position, np.float64), np.asarray(time, np.float64)
    if (not lag >= 0.0 or position.ndim != 3 or time.shape != (len(position),)
            or np.shape(mount_pose) != (len(position), 4, 4)):
        raise SensorError(f"dense force: lag {lag} s, positions {position.shape}, mount poses {np.shape(mount_pose)} "
                          f"and times {time.shape}; give a lag of at least 0, (T, N, 3), (T, 4, 4) and (T,).")
    turn, shift = mount_pose[:, :3, :3], mount_pose[:, None, :3, 3]
    local = np.einsum("tni,tij->tnj", position - shift, turn)
    good = np.isfinite(local).all(axis=(1, 2))
    known, out = time[good], np.full(position.shape, np.nan)
    # a frame whose image falls on the last one, up to rounding, still has it
    shown = good & (time + lag <= (known[-1] + 1e-9 if len(known) > 1 else -np.inf))
    if shown.any():
        after = np.clip(np.searchsorted(known, time[shown] + lag), 1, len(known) - 1)
        share = np.clip((time[shown] + lag - known[after - 1]) / (known[after] - known[after - 1]), 0.0, 1.0)
        share = share[:, None, None]
        late = (1.0 - share) * local[good][after - 1] + share * local[good][after]
        out[shown] = np.einsum("tni,tji->tnj", late, turn[shown]) + shift[shown]
    return out


def estimate_forces(touch: Touch, *, stiffness: float, method: str = "membrane",
                    options: EstimatorOptions | None = None, position: np.ndarray | None = None,
                    pressure: np.ndarray | None = None, image_lag: float = 0.0) -> DenseForce:
    """Contact forces on the nodes of a dataset's touch, estimated by `DenseForceEstimator`, in the world.

    Args:
        touch: made by a bubble.
        stiffness: E h of its skin [N/m].
        method, options: of the estimator.
        position: measured nodes, world (T, N, 3) [m], e.g. of `vsfsim.bench.noise.noisy_nodes`; None for the
            true ones.
        pressure: measured gauge pressure (T,) [Pa]; None for the true one.
        image_lag: delay of ``position`` against ``pressure`` [s], which is taken out first (`aligned_nodes`). A real
            Punyo has 0.077 s; without that the forces of a moving sensor are wrong by more than their size.

    Returns:
        Forces and positions in the world. They are NaN, and ``converged`` is False, in frames of the touch that did
        not converge, and with a lag in those at its end whose image was never taken.

    Raises:
        SensorError: the touch was made by a rigid probe, or the readings have other shapes than the touch.
    """
    if (touch.node_position is None or touch.node_rest is None or touch.node_triangles is None
        or touch.pressure is None or touch.rest_pressure is None):
        raise SensorError("dense force: the touch has no node positions or no pressure; its dataset must be made with "
                          "a bubble, a [sensor] in the scene.")
    position = np.asarray(touch.node_position if position is None else position, np.float64)
    pressure = np.asarray(touch.pressure if pressure is None else pressure, np.float64)
    if position.shape != touch.node_position.shape or pressure.shape != touch.pressure.shape:
        raise SensorError(f"dense force: positions {position.shape} and pressures {pressure.shape}; the touch has "
                          f"{touch.node_position.shape} and {touch.pressure.shape}.")
    calibration = BubbleCalibration(touch.node_rest, touch.node_triangles,
                                    rim_of(touch.node_triangles, len(touch.node_rest)), stiffness, touch.rest_pressure,
                                    reference=touch.node_reference)
    if image_lag != 0.0:
        position = aligned_nodes(position, touch.mount_pose, touch.time, image_lag)
    good = np.asarray(touch.converged, bool) & np.isfinite(position).all(axis=(1, 2))
    turn, shift = touch.mount_pose[good, :3, :3], touch.mount_pose[good, None, :3, 3]
    found = DenseForceEstimator(calibration, method=method,
                                options=options).estimate(np.einsum("tni,tij->tnj", position[good] - shift, turn),
                                                          pressure[good])
    force, place, residual = (np.full((len(good), *value.shape[1:]), np.nan)
                              for value in (found.force, found.position, found.residual))
    out = DenseForce(force, place, residual, np.zeros(len(good), bool))
    out.force[good] = np.einsum("tni,tji->tnj", found.force, turn)
    out.position[good] = np.einsum("tni,tji->tnj", found.position, turn) + shift
    out.residual[good], out.converged[good] = found.residual, found.converged
    return out


def rim_of(triangles: np.ndarray, nodes: int) -> np.ndarray:
    """True (n,) at the boundary nodes of an open mesh: those on edges that belong to only one triangle (m, 3)."""
    edges, count = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0,
                             return_counts=True)
    out = np.zeros(nodes, bool)
    out[edges[count == 1]] = True
    return out
