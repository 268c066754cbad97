"""Where touches aim: targets drawn on the visible cloud, and first contact with the object at rest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core import shape as shapes
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene
from vsfsim.core.scene_tables.dataset import STEEPEST
from vsfsim.core.shape import MeshFile, Plane, ProbeShape
from vsfsim.data.records import View
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.body_samples import sharp_samples
from vsfsim.physics.contact.patch import face_grid
from vsfsim.physics.mesh.surface_distance import crossings
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import turn_to

DRAWS = 200  # targets that are tried for one touch
_STEPS = 8  # of the linear press that finds the depth of the force limit
BLOCKED = 0.015  # something else that is met this far before the target makes the target unreachable [m]

_NEIGHBOURS = 40  # points of the cloud that a normal is fitted to
_RADIUS = 0.012  # and how far away they may be [m]


@dataclass(frozen=True)
class Aim:
    """One touch before it is made."""

    target: np.ndarray
    """Point of the visible cloud (3,) [m]."""
    normal: np.ndarray
    """Outward unit normal of the cloud there (3,) [-]."""
    axis: np.ndarray
    """Unit direction of the press (3,) [-]."""
    contact: np.ndarray
    """Position of the probe's centre, or of the bubble's mount, at first contact with the object at rest (3,) [m]."""
    depth: float
    """How far the press goes past first contact [m]."""
    approach: float | None = None
    """Distance of its start before first contact [m]; None for the scene's."""
    press: int = 0
    """Which of the scene's kinds of press it is (`Scene.presses`)."""
    late: float = 0.0
    """By how much the probe is deeper than its recorded poses say [m]."""
    path: np.ndarray | None = None
    """Planned poses of the probe or its mount (T, 4, 4) [m]; None for the effector's own plan."""
    start: np.ndarray | None = None
    """Where the path begins (4, 4) [m]; None: turned as the first pose, at the approach."""


def surface_samples(model: Model) -> np.ndarray:
    """Points that cover the boundary of a body at rest (k, 3) [m]: every triangle at a 6 x 6 barycentric grid."""
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    return np.einsum("sk,fkc->fsc", face_grid(6, 3), corners).reshape(-1, 3)


def clearance(model: Model, probe: ProbeShape, pose: np.ndarray, axis: np.ndarray, *,
              samples: np.ndarray | None = None) -> float:
    """How far the probe can go from ``pose`` (4, 4) along the unit ``axis`` (3,) before it meets the body at rest [m].

    Conservative advancement on the signed distance; edges and corners that meet the boundary between its samples count,
    too. Edges are sharp on a solid, whose contact has points on them, and have their fillet on a sheet, which feels no
    more than that. Infinite if the probe meets nothing within 2 m.
    """
    fillet = sdf.encode(probe)[1][3] if model.mesh.faces.shape[1] == 3 else 0.0
    return min(_advance(model, probe, pose, axis, samples, fillet), _edges_first(model, probe, pose, axis, fillet))


def _advance(model: Model, probe: ProbeShape, pose: np.ndarray, axis: np.ndarray, samples: np.ndarray | None,
             fillet: float) -> float:
    points = surface_samples(model) if samples is None else samples
    gone = 0.0
    for _ in range(500):
        local = (points - pose[:3, 3] - gone * axis) @ pose[:3, :3]
        gap = float((sdf.distance(probe, local) if isinstance(probe, MeshFile)
                     else shapes.distance(probe, local, fillet=fillet)).min())  # type: ignore[arg-type]
        if gap < 1e-6 or gone > 2.0:
            break
        gone += gap
    return gone if gone <= 2.0 else float("inf")


def _edges_first(model: Model, probe: ProbeShape, pose: np.ndarray, axis: np.ndarray, fillet: float) -> float:
    """The same for the edges and corners of the probe alone: their points, or those of the fillet that lie furthest
    along the axis, against the triangles at rest."""
    sharp, outward, length = sharp_samples(probe, 0.5 * model.element_size)
    ahead = pose[:3, :3].T @ axis
    leading = outward @ ahead > 0.0
    if not leading.any():  # a ball, say
        return float("inf")
    sides = np.where(length > 0.0, 2.0, 3.0)[:, None]  # that meet on an edge, and in a corner
    spot = sharp + fillet * (ahead - np.sqrt(sides) * outward)
    spot = (spot @ pose[:3, :3].T + pose[:3, 3])[leading]
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    side, up = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    corners = corners[np.cross(side, up) @ axis < 0.0]  # faces that look at the probe
    ways = (crossings(p[None], axis[None], corners) for p in spot)
    return min(float(way[way >= 0.0].min(initial=np.inf)) for way in ways)


def draw_aims(scene: Scene, view: View, stream: Callable[[int], np.random.Generator],
              reach: Callable[[int, np.ndarray, np.ndarray, np.random.Generator], Aim | None], *,
              unreachable: str) -> list[Aim]:
    """Draw the touches of a view: targets uniform on the visible cloud; one that cannot be reached is drawn again.

    Args:
        scene: with ``[touches]``.
        view: the picture.
        stream: random stream of touch k; each touch has its own, so that asking for more keeps the first ones.
        reach: touch k at a target (3,) [m] with its normal (3,), or None if it cannot be made.
        unreachable: end of the error's sentence "no target of 200 can be reached ...".

    Raises:
        SceneError: nothing is visible, or no reachable target was found in `DRAWS` draws.
    """
    cloud = view.points()
    if not len(cloud):
        raise SceneError(f"{scene.source}: the camera sees no object; check [camera] distance, "
                         "azimuth, elevation and fov.")
    eye, tree = view.camera_pose[:3, 3], cKDTree(cloud)
    out: list[Aim] = []
    for k in range(scene.required_touches.count):
        rng = stream(k)
        for _ in range(DRAWS):
            target = cloud[rng.integers(len(cloud))]
            found = reach(k, target, cloud_normals(cloud, target[None], eye, tree=tree)[0], rng)
            if found is not None:
                out.append(found)
                break
        else:
            raise SceneError(f"{scene.source} [touches]: no target of {DRAWS} can be reached {unreachable}")
    return out


def aim_probe(scene: Scene, model: Model, view: View, stream: Callable[[int], np.random.Generator],
              *, device: str = "cpu") -> list[Aim]:
    """The touches of a view by the scene's rigid probes, each along the visible normal, tilted from it, or level.

    A target cannot be reached where another part of the object, or the table (z < 0), is in the way. The depth is cut
    where the rest state's linear response passes ``force_limit``, as a careful robot would stop.

    Args:
        scene: with ``[touches]``.
        model: the object.
        view, stream: as of `draw_aims`.
        device: Warp device.

    Raises:
        SceneError: as `draw_aims`.
    """
    spec, presses, samples = scene.required_touches, scene.presses, surface_samples(model)

    def reach(k: int, target: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> Aim | None:
        found = _aim_at(presses[spec.kind(k)], model, samples, target, normal, rng)
        return None if found is None else dataclasses.replace(found, press=spec.kind(k))

    aims = draw_aims(scene, view, stream, reach, unreachable="without meeting the table or another "
                     "part first; use a smaller probe, approach or depth.")
    return in_kinds(presses, aims, lambda press, mine: _limit(press, model, [aims[k] for k in mine], device))


T = TypeVar("T")


def in_kinds(presses: Sequence[Scene], aims: Sequence[Aim], work: Callable[[Scene, list[int]], list[T]]) -> list[T]:
    """What ``work`` makes of the aims of each kind of press, given as their indices, in the order of all aims."""
    out: dict[int, T] = {}
    for number, press in enumerate(presses):
        mine = [k for k, a in enumerate(aims) if a.press == number]
        out |= zip(mine, work(press, mine), strict=True)
    return [out[k] for k in range(len(aims))]


def _aim_at(press: Scene, model: Model, samples: np.ndarray, target: np.ndarray, normal: np.ndarray,
            rng: np.random.Generator) -> Aim | None:
    probe, spec, axis = press.probe, press.required_touches, -normal
    if spec.level:
        if abs(normal[2]) > STEEPEST:
            return None
        axis = np.append(axis[:2], 0.0) / np.linalg.norm(axis[:2])
    if spec.tilt != 0.0:
        axis = tilted(axis, spec.tilt, rng)
    depth, approach = spec.draw_depth(rng), spec.draw_approach(rng)
    late = 0.0 if spec.late_range is None else float(rng.uniform(*spec.late_range))
    size = sdf.support(probe, turn_to(axis, probe).T @ axis)
    # the probe starts outside the whole body, so that what it meets first is the first thing on its line
    away = float(np.linalg.norm(samples - target, axis=1).max()) + 2.0 * size
    pose = probe_pose(probe, target - away * axis, axis)
    gone = clearance(model, probe, pose, axis, samples=samples)
    contact = pose[:3, 3] + gone * axis if np.isfinite(gone) else target - size * axis
    if (target - contact) @ axis - size > BLOCKED:
        return None
    ends = [contact - approach * axis, contact + (depth + late) * axis]
    down = sdf.support(probe, pose[:3, :3].T @ np.array([0.0, 0.0, -1.0]))
    if min(p[2] for p in ends) - down < 0.0:
        return None
    return Aim(target, normal, axis, contact, depth, approach, late=late)


def tilted(axis: np.ndarray, most: float, rng: np.random.Generator) -> np.ndarray:
    """A direction (3,) drawn evenly, by solid angle, from the cone of half angle ``most`` [rad] about a unit ``axis``
    (3,)."""
    height = 1.0 - rng.random() * (1.0 - np.cos(most))
    turn = 2.0 * np.pi * rng.random()
    side = turn_to(axis, Plane())[:, :2] @ [np.cos(turn), np.sin(turn)]
    return height * axis + np.sqrt(max(0.0, 1.0 - height**2)) * side


def _limit(scene: Scene, model: Model, aims: list[Aim], device: str) -> list[Aim]:
    """Cut the depths by one linear press each: its force grows at least linearly with depth, so one cut from a few
    frames suffices. A spring at the mount takes its part of the travel."""
    spec, spring = scene.required_touches, scene.mount_stiffness
    if not aims or (spring is not None and spring * spec.depth <= spec.force_limit):  # which it cannot carry
        return aims
    depth = spec.depth * np.arange(_STEPS + 1) / _STEPS  # from first contact, so that all frames have a way
    out = []
    poses = np.stack([[probe_pose(scene.probe, a.contact + d * a.axis, a.axis) for a in aims] for d in depth])
    # A limit of seconds would cut touches by how busy the machine is; iterations are limited.
    frames = Solver(model, scene.probe, friction=scene.required_object.friction, device=device,
                    linear=True, options=SolverOptions(tolerance=1e-3, local_indentation=True,
                                                       seconds=float("inf"))).run(poses)
    for k, a in enumerate(aims):
        found = frames.converged[:, k]
        if not found[1:].any():
            raise SceneError(f"{scene.source} [touches]: the linear response to the touch at "
                             f"{a.target.round(3)} m was not found: "
                             f"{Reason(int(frames.reason[-1, k])).text}. Use a smaller depth.")
        curve = _over_depth(depth, np.linalg.norm(frames.force[:, k], axis=1), found)
        over = np.flatnonzero(curve > spec.force_limit)
        cut = spec.depth
        if len(over):
            i = int(over[0])
            share = (spec.force_limit - curve[i - 1]) / (curve[i] - curve[i - 1])
            cut = spec.depth * (i - 1 + share) / _STEPS + (spec.force_limit / spring if spring else 0.0)
        out.append(dataclasses.replace(a, depth=min(a.depth, float(cut))))
    return out


def _over_depth(depth: np.ndarray, force: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Force [N] at each ``depth`` (k,) [m], none at the first, from frames that were ``found`` (k,): straight between
    them, and on past the last as just before it. A frame without an equilibrium tells no force."""
    at, known = np.append(0.0, depth[1:][found[1:]]), np.append(0.0, force[1:][found[1:]])
    slope = (known[-1] - known[-2]) / (at[-1] - at[-2])
    return np.where(depth > at[-1], known[-1] + slope * (depth - at[-1]), np.interp(depth, at, known))


def starts(scene: Scene, aims: Sequence[Aim], poses: np.ndarray) -> np.ndarray:
    """Where the paths of touches begin (B, 4, 4): turned as their first ``poses`` (B, 4, 4), at their approach."""
    out = poses.copy()
    for pose, a in zip(out, aims, strict=True):
        if a.start is not None:
            pose[:] = a.start
        else:
            pose[:3, 3] = a.contact - (scene.required_touches.approach if a.approach is None else a.approach) * a.axis
    return out


def probe_pose(probe: ProbeShape, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a probe at ``centre`` (3,) [m] that leads along ``axis`` (3,)."""
    pose = np.eye(4)
    pose[:3, :3] = turn_to(axis, probe)
    pose[:3, 3] = centre
    return pose


def cloud_normals(cloud: np.ndarray, at: np.ndarray, eye: np.ndarray, *, tree: cKDTree | None = None) -> np.ndarray:
    """Outward unit normals (k, 3) of a point cloud (n, 3) [m] at ``at`` (k, 3): the direction of least variance of the
    neighbours.

    Args:
        eye: the camera's centre (3,) [m]; a visible surface faces it.
        tree: of the cloud; None to make it.
    """
    tree = tree or cKDTree(cloud)
    distance, index = tree.query(at, k=min(_NEIGHBOURS, len(cloud)), distance_upper_bound=_RADIUS)
    out = np.empty_like(at)
    for i in range(len(at)):
        near = cloud[index[i][np.isfinite(distance[i])]]
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][-1] if len(near) >= 3 else eye - at[i]
        normal = normal / np.linalg.norm(normal)
        out[i] = normal if normal @ (eye - at[i]) >= 0 else -normal
    return out


def voxel_sample(cloud: np.ndarray, size: float) -> np.ndarray:
    """One point of the cloud (n, 3) [m] for every occupied voxel of edge ``size`` [m]: the one nearest to the mean of
    the voxel's points (k, 3) [m]."""
    cell = np.floor(cloud / size).astype(np.int64)
    _, group = np.unique(cell, axis=0, return_inverse=True)
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, cloud[:, c]) / count for c in range(3)], axis=1)
    off = np.linalg.norm(cloud - mean[group], axis=1)
    order = np.lexsort((np.arange(len(cloud)), off, group))
    return cloud[order[np.unique(group[order], return_index=True)[1]]]
