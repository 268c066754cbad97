"""The motion of a probe: poses of a press or of a touch, with or without an arm."""

from __future__ import annotations

import numpy as np

from vsfsim.core.rigid import PressSpec, RigidBody
from vsfsim.core.rotation import between, rotation_matrix
from vsfsim.core.scene import Scene, TouchSpec
from vsfsim.core.shape import Plane, ProbeShape

FRAME_SECONDS = 1.0 / 30.0  # at the Punyo's frame rate [s]


def turn_to(axis: np.ndarray, probe: ProbeShape) -> np.ndarray:
    """A rotation (3, 3) that points the probe along the direction of travel ``axis`` (3,).

    The probe's -z points forward, except for a plane, whose surface faces its own +z. Its x is as horizontal as it can
    be, so the same axis always gives the same rotation.
    """
    z = np.asarray(axis, float) / np.linalg.norm(axis)
    if not isinstance(probe, Plane):
        z = -z
    side = np.array([0.0, 1.0, 0.0]) if abs(z[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(side, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def poses_of(positions: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Poses (T, 4, 4) at positions (T, 3) [m] with one rotation (3, 3)."""
    out = np.tile(np.eye(4), (len(positions), 1, 1))
    out[:, :3, :3] = rotation
    out[:, :3, 3] = positions
    return out


def press_path(spec: PressSpec, probe: ProbeShape) -> np.ndarray:
    """Poses (T, 4, 4) of a one-off press: along its path, hold, and back the same way."""
    inward = np.stack([pose_at(spec, probe, k) for k in range(1, spec.inward + 1)])
    parts = [inward, np.repeat(inward[-1:], spec.hold, axis=0)]
    if spec.retract:
        # frames of the way in where their number allows, so that both ways have the same equilibria
        back = np.concatenate([inward[::-1][1:], pose_at(spec, probe, 0)[None]])
        if spec.retract <= len(back):
            parts.append(back[np.linspace(-1, len(back) - 1, spec.retract + 1).round().astype(int)[1:]])
        else:
            parts.append(np.stack([pose_at(spec, probe, spec.inward * (1 - k / spec.retract))
                                   for k in range(1, spec.retract + 1)]))
    return np.concatenate(parts)


def pose_at(spec: PressSpec, probe: ProbeShape, frame: float) -> np.ndarray:
    """Pose (4, 4) of the probe at ``frame`` of the way in, from 0 at the first point of the path to `PressSpec.inward`
    at the last."""
    ends = np.cumsum((0, *spec.frames))
    part = int(np.clip(np.searchsorted(ends, frame, side="left") - 1, 0, len(spec.frames) - 1))
    share = (frame - ends[part]) / spec.frames[part]
    a, b = (np.array(p) for p in spec.path[part:part + 2])
    out = np.eye(4)
    out[:3, 3] = a + share * (b - a)
    if spec.rotation is None:
        out[:3, :3] = turn_to(np.array(spec.path[1]) - np.array(spec.path[0]), probe)
    else:
        out[:3, :3] = between(rotation_matrix(spec.rotation[part]), rotation_matrix(spec.rotation[part + 1]), share)
    return out


def body_poses(scene: Scene, poses: np.ndarray) -> np.ndarray:
    """Poses (T, K, 4, 4) of all rigid bodies of a scene, in the order of `Scene.bodies`, for poses (T, 4, 4) of the
    probe."""
    with_probe = [poses @ _place(part) for part in scene.parts]
    fixed = [np.broadcast_to(_place(obstacle), poses.shape) for obstacle in scene.obstacles]
    return np.stack([poses, *with_probe, *fixed], axis=1)


def _place(body: RigidBody) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = rotation_matrix(body.rotation)
    out[:3, 3] = body.position
    return out


def touch_path(spec: TouchSpec, probe: ProbeShape, contact: np.ndarray, axis: np.ndarray, *,
               depth: float | None = None, approach: float | None = None) -> np.ndarray:
    """Poses (T, 4, 4) of one scripted touch: wait without contact, straight in, hold, straight out.

    Args:
        spec: depth, approach and frames of each phase.
        probe: shape of the probe.
        contact: position of the probe's centre when its surface reaches the target (3,) [m].
        axis: unit direction of the press (3,).
        depth: travel after the first contact [m], or None for the scene's.
        approach: distance of the start before first contact [m], or None for the scene's.
    """
    free, inward, hold, out = spec.frames
    start = contact - (spec.approach if approach is None else approach) * axis
    # the waiting frames, at rest at the start, are the sensor's tare
    waiting = np.repeat(start[None], free, axis=0)
    # the frames of the way in cover the depth only; on the way from the start to the surface nothing touches
    deep = (spec.depth if depth is None else depth) * axis
    way_in = contact + np.arange(1, inward + 1)[:, None] / inward * (contact + deep - contact)
    parts = [waiting, way_in, np.repeat(way_in[-1:], hold, axis=0)]
    if out:
        back = np.concatenate([way_in[::-1][1:], contact[None]])
        at = np.linspace(-1, len(back) - 1, out + 1).round().astype(int)[1:]
        parts.append(back[at])
    return poses_of(np.concatenate(parts), turn_to(axis, probe))


def times(frames: int) -> np.ndarray:
    """Time of each frame (frames,) [s] at the sensor's rate."""
    return FRAME_SECONDS * np.arange(frames)
