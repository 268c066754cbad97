"""Touches of one object view: where the probe aims, how far it goes, and what the solver answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, TouchSpec
from vsfsim.core.shape import ProbeShape
from vsfsim.data.records import AUDIT_COLUMNS, Touch, View
from vsfsim.physics.contact import sdf
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames, Reason, SolverOptions
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import times, touch_path, turn_to

_NEIGHBOURS = 40  # points of the cloud that vote for a normal
_RADIUS = 0.012  # and how far away they may be [m]
_BLOCKED = 0.015  # a probe that meets something else this far before its target cannot reach it [m]


@dataclass(frozen=True)
class Aim:
    """One touch before it is made.

    target: on the visible cloud (3,) [m]. normal: outward there (3,). axis: of the press (3,), minus the normal.
    contact: the probe's centre when it first meets the body at rest (3,) [m]. depth: past that [m].
    """

    target: np.ndarray
    normal: np.ndarray
    axis: np.ndarray
    contact: np.ndarray
    depth: float


def cloud_normals(cloud: np.ndarray, at: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Outward unit normals (k, 3) of a point cloud (n, 3) [m] at ``at`` (k, 3): least-variance direction of the
    neighbours.

    Args:
        eye: the camera's centre (3,) [m]; a visible surface faces it.
    """
    tree = cKDTree(cloud)
    distance, index = tree.query(at, k=min(_NEIGHBOURS, len(cloud)), distance_upper_bound=_RADIUS)
    out = np.empty_like(at)
    for i in range(len(at)):
        near = cloud[index[i][np.isfinite(distance[i])]]
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][-1] if len(near) >= 3 else eye - at[i]
        normal = normal / np.linalg.norm(normal)
        out[i] = normal if normal @ (eye - at[i]) >= 0 else -normal
    return out


def _surface_samples(model: Model) -> np.ndarray:
    """Points that cover the boundary of a body at rest (k, 3) [m]: every triangle at a 6 x 6 barycentric grid."""
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    steps = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)]) / 6.0
    return np.einsum("sk,fkc->fsc", steps, corners).reshape(-1, 3)


def clearance(model: Model, probe: ProbeShape, pose: np.ndarray, axis: np.ndarray, *,
              samples: np.ndarray | None = None) -> float:
    """How far the probe can go from ``pose`` (4, 4) along the unit ``axis`` (3,) before it meets the body at rest [m].

    Conservative advancement on the signed distance; infinite if it meets nothing within 2 m.
    """
    points = _surface_samples(model) if samples is None else samples
    gone = 0.0
    for _ in range(500):
        local = (points - pose[:3, 3] - gone * axis) @ pose[:3, :3]
        gap = float(sdf.distance(probe, local).min())
        if gap < 1e-6:
            return gone
        gone += gap
        if gone > 2.0:
            return float("inf")
    return gone


def aim(scene: Scene, spec: TouchSpec, model: Model, view: View, stream: Callable[[int], np.random.Generator], *,
        device: str = "cpu") -> list[Aim]:
    """Draw the touches of a view: uniform on the visible cloud, along its normal.

    Targets that the probe cannot reach are drawn again: another part of the object is in the way, or the table (z < 0)
    is. The depth is cut where the rest state's linear response passes ``force_limit``, as a careful robot would stop.

    Args:
        stream: random stream of touch k; each touch has its own, so that asking for more keeps the first ones. device:
        Warp device.

    Raises:
        SceneError: nothing is visible, or no reachable target was found in 200 draws.
    """
    cloud = view.points()
    if not len(cloud):
        raise SceneError(f"{scene.source}: the camera sees no object; check [camera] distance, azimuth, "
                         f"elevation and fov.")
    eye = view.camera_pose[:3, 3]
    samples = _surface_samples(model)
    out: list[Aim] = []
    for k in range(spec.count):
        rng = stream(k)
        for _ in range(200):
            target = cloud[rng.integers(len(cloud))]
            normal = cloud_normals(cloud, target[None], eye)[0]
            found = _aim_at(scene, spec, model, samples, target, normal)
            if found is not None:
                out.append(found)
                break
        else:
            raise SceneError(f"{scene.source} [touches]: no target of 200 can be reached without meeting the table or "
                             f"another part first; "
                             "use a smaller probe, approach or depth.")
    return _limit(scene, spec, model, out, device)


def _aim_at(scene: Scene, spec: TouchSpec, model: Model, samples: np.ndarray, target: np.ndarray,
            normal: np.ndarray) -> Aim | None:
    probe, axis = scene.probe, -normal
    rotation = turn_to(axis, probe)
    size = sdf.support(probe, rotation.T @ axis)
    pose = np.eye(4)
    pose[:3, :3] = rotation
    # from outside the whole body, so that the first thing met is the first thing there
    away = float(np.linalg.norm(samples - target, axis=1).max()) + 2.0 * size
    pose[:3, 3] = target + away * normal
    gone = clearance(model, probe, pose, axis, samples=samples)
    contact = pose[:3, 3] + gone * axis if np.isfinite(gone) else target + size * normal
    if (contact - target) @ normal - size > _BLOCKED:
        return None
    low = [contact - spec.approach * axis, contact + spec.depth * axis]
    down = sdf.support(probe, rotation.T @ np.array([0.0, 0.0, -1.0]))
    if min(p[2] for p in low) - down < 0.0:
        return None
    return Aim(target, normal, axis, contact, spec.depth)


def _limit(scene: Scene, spec: TouchSpec, model: Model, aims: list[Aim], device: str) -> list[Aim]:
    """Cut the depths by one linear press each: its force grows at least linearly with depth, so one cut from a few
    frames suffices."""
    if not aims:
        return aims
    steps = 8
    depth = spec.depth * np.arange(1, steps + 1) / steps
    poses = np.stack([[_pose(scene.probe, a.contact + d * a.axis, a.axis) for a in aims] for d in depth])
    frames = Solver(model, scene.probe, friction=scene.object.friction, device=device,
                    options=SolverOptions(tolerance=1e-3), linear=True).run(poses)
    force = np.linalg.norm(frames.force, axis=-1)
    out = []
    for k, a in enumerate(aims):
        curve = np.concatenate([[0.0], force[:, k]])
        over = np.flatnonzero(curve > spec.force_limit)
        cut = spec.depth
        if len(over):
            i = int(over[0])
            share = (spec.force_limit - curve[i - 1]) / (curve[i] - curve[i - 1])
            cut = spec.depth * (i - 1 + share) / steps
        out.append(Aim(a.target, a.normal, a.axis, a.contact, float(cut)))
    return out


def _pose(probe: ProbeShape, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = turn_to(axis, probe)
    pose[:3, 3] = centre
    return pose


def touch_all(scene: Scene, spec: TouchSpec, model: Model, aims: list[Aim], *, options: SolverOptions, linear: bool,
              device: str, precision: str, batch: int, progress: Callable[[int], None] | None = None) -> list[Touch]:
    """Simulate touches, ``batch`` at a time (fixed, so that the bits do not depend on who runs it).

    Args:
        progress: called with the number of frames newly done.
    """
    out: list[Touch] = []
    for start in range(0, len(aims), batch):
        part = aims[start:start + batch]
        poses = np.stack([touch_path(spec, scene.probe, a.contact, a.axis, depth=a.depth) for a in part], axis=1)
        solver = Solver(model, scene.probe, friction=scene.object.friction, device=device, precision=precision,
                        options=options, linear=linear)
        width = len(part)
        frames = solver.run(poses, progress=None if progress is None else lambda _, k=width: progress(k))
        out.extend(_record(a, poses[:, k], frames, k) for k, a in enumerate(part))
    return out


def audit(frames: Frames, column: int) -> dict[str, np.ndarray]:
    """The audit columns (T,) of one touch, by the names of the dataset."""
    return {name: getattr(frames, name)[:, column] for name in AUDIT_COLUMNS}


OUT_OF_BALANCE = "force on the probe and reaction of the supports differ by over 0.1 %"
_BALANCE = 1e-3  # design: the audit's limit
REASONS = (*(reason.text for reason in Reason if reason != Reason.NONE), OUT_OF_BALANCE)


def _record(a: Aim, poses: np.ndarray, frames: Frames, k: int) -> Touch:
    found = frames.converged[:, k] & np.isfinite(frames.force[:, k]).all(axis=1)
    converged = found & (frames.force_balance[:, k] <= _BALANCE)
    return Touch(
        time=times(len(poses)), mount_pose=poses, axis=a.axis, target=a.target, normal=a.normal,
        force=frames.force[:, k], reaction=frames.reaction[:, k], converged=converged, residual=frames.residual[:, k],
        iterations=frames.iterations[:, k], touched=bool((frames.penetration[:, k] > 0.0).any()),
        # the solver's own reasons keep their codes, the audit's comes after them
        reason=np.where(converged, 0, np.where(found, len(REASONS), frames.reason[:, k])), reason_names=REASONS,
                 audit=audit(frames, k))
