"""Touches of one object view by an air-filled bubble: where its mount aims, how far it goes, and what both bodies
answer.

As the rigid probe's (`touch.py`): the mount comes in along the normal that the camera sees, its +z leading, or tilted
from it. The apex of the free dome points at the target; depth counts from where the dome, undented, first meets the
object at rest, which may be beside the apex.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vsfsim.core.bubble import CAMERA
from vsfsim.core.dome import Dome
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, TouchSpec
from vsfsim.core.shape import Plane
from vsfsim.data.records import Touch, View
from vsfsim.generate.effectors.probe import _BALANCE, _BLOCKED, REASONS, Aim, _surface_samples, audit, cloud_normals
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.contact.pair_surfaces import SENSOR_NODES
from vsfsim.physics.model import Model
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.robot.path import times, touch_path, turn_to
from vsfsim.sensing.bubble import readout_of
from vsfsim.sensing.bubble_camera import BubbleCamera
from vsfsim.sensing.bubble_touch import touch_fields

BATCH = {"cpu": 9, "cuda": 256}  # touches that advance together; part of what fixes the bits
KINDS = ("tet10", "triangle", "hinge", "gas")  # of the elements of object and bubble
_LEADS = Plane()  # as a plane's, a sensor's +z leads
_PATIENCE = 200  # conjugate gradients of a touch in one frame
# Newton iterations of a touch in one frame, on a GPU: there hundreds of touches wait for the last one, whose steps cost
# as much as everybody's
_STEPS = 30
_GRID = 1e-3  # of the places at which the dome is cut by a wall [m]


def tier_for(scene: Scene, asked: str | None) -> str:
    """The tier of the object under a bubble: as `tiers.choose`, at least ``fem-coarse``.

    Raises:
        SceneError: a tier was asked for that a bubble cannot press.
    """
    chosen = tiers.choose(scene, asked)
    if tiers.TIERS[chosen].nonlinear and chosen != "spring":
        return chosen
    if (asked or scene.object.tier) != "auto":
        raise SceneError(f"{scene.source}: tier '{chosen}' cannot be touched by a [sensor], which bends far; use "
                         f"'fem-coarse' or finer.")
    return "fem-coarse"


def check(scene: Scene, precision: str) -> None:
    """Refuse at once what could not be touched.

    Raises:
        SceneError: single precision, too many nodes, a bubble that cannot be inflated, or a depth that the dome has
        not.
    """
    assert scene.sensor is not None and scene.touches is not None
    if precision != "float64":
        raise SceneError(f"{scene.source}: --precision is '{precision}', but a [sensor] is solved in float64 only: at "
                         f"rest its skin balances some 50 N of gas pressure node by node, "
                         "and single precision leaves more of it unbalanced than a light touch pushes.")
    if scene.sensor.nodes > SENSOR_NODES:
        raise SceneError(f"{scene.source} [sensor]: nodes is {scene.sensor.nodes}; against an object up to "
                         f"{SENSOR_NODES} are allowed, since the skin's compliance is kept whole. Give fewer.")
    height = float(build_bubble(scene.sensor, where=f"{scene.source} [sensor]").mesh.points[:, 2].max())
    if scene.touches.depth > height:
        raise SceneError(f"{scene.source} [touches]: depth is {scene.touches.depth:g} m, but the free dome of the "
                         f"[sensor] is {height:.4f} m high; its rim would go into the object. Give less.")


def dome_of(model: BubbleModel) -> Dome:
    """The free dome on the read-out mesh: what a dataset says of its sensor's shape."""
    seen = readout_of(model)
    return Dome.of(seen.positions(model.mesh.points[None])[0], seen.readout.triangles)


def aim(scene: Scene, spec: TouchSpec, model: Model, sensor: BubbleModel, view: View,
        stream: Callable[[int], np.random.Generator]) -> list[Aim]:
    """Draw the touches of a view: uniform on the visible cloud, along its normal or tilted from it.

    Targets that the dome cannot reach are drawn again: another part of the object is more than `_BLOCKED` in the way,
    or the table (z < 0) is.

    Args:
        spec: how many, and how deep. model: the object. sensor: the bubble. stream: random stream of touch k.

    Raises:
        SceneError: nothing is visible, or no reachable target was found in 200 draws.
    """
    cloud = view.points()
    if not len(cloud):
        raise SceneError(f"{scene.source}: the camera sees no object; check [camera] distance, azimuth, "
                         f"elevation and fov.")
    eye = view.camera_pose[:3, 3]
    samples, dome = _surface_samples(model), dome_of(sensor)
    depth = min(spec.depth, depth_at(sensor, spec.force_limit))
    out: list[Aim] = []
    for k in range(spec.count):
        rng = stream(k)
        for _ in range(200):
            target = cloud[rng.integers(len(cloud))]
            normal = cloud_normals(cloud, target[None], eye)[0]
            axis = -normal if spec.tilt == 0.0 else tilted(-normal, spec.tilt, rng)
            contact = first_contact(dome, samples, target, axis)
            if _reachable(dome, contact, target, axis, depth, spec.approach):
                out.append(Aim(target, normal, axis, contact, depth))
                break
        else:
            raise SceneError(f"{scene.source} [touches]: no target of 200 can be reached by the [sensor] without "
                             f"meeting the table or another part first; "
                             "use a smaller bubble, approach or depth, or an object with more free surface.")
    return out


def tilted(axis: np.ndarray, most: float, rng: np.random.Generator) -> np.ndarray:
    """A direction (3,) drawn evenly, by solid angle, from the cone of half angle ``most`` [rad] about a unit ``axis``
    (3,)."""
    height = 1.0 - rng.random() * (1.0 - np.cos(most))
    turn = 2.0 * np.pi * rng.random()
    side = turn_to(axis, _LEADS)[:, :2] @ [np.cos(turn), np.sin(turn)]
    return height * axis + np.sqrt(max(0.0, 1.0 - height**2)) * side


def first_contact(dome: Dome, samples: np.ndarray, target: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The mount's origin (3,) [m] when the free dome, coming in along ``axis`` with its apex over ``target``, first
    meets a body.

    Args:
        dome: the sensor. samples: points that cover the body's surface (k, 3) [m]. target: a point (3,) [m]. axis: unit
        direction of the press (3,).
    """
    local = (samples - target) @ turn_to(axis, _LEADS)
    # with the apex over it, the target itself is met at the latest: no point beyond its plane comes before it
    before = local[local[:, 2] < 0.0]
    gone = dome.heights(before[:, :2]) - before[:, 2]
    return target - max(float(gone.max(initial=-np.inf)), dome.height) * axis


def _reachable(dome: Dome, contact: np.ndarray, target: np.ndarray, axis: np.ndarray, depth: float,
               approach: float) -> bool:
    if (target - contact) @ axis - dome.height > _BLOCKED:
        return False
    low = float((dome.points @ turn_to(axis, _LEADS).T)[:, 2].min())
    return min(contact[2] + depth * axis[2], contact[2] - approach * axis[2]) + low >= 0.0


def depth_at(sensor: BubbleModel, force: float) -> float:
    """Depth [m] at which a flat rigid wall would push with ``force`` [N]; infinite if it never does before the rim.

    A plate carries pressure times contact area; both are taken of the free dome cut by the wall, which is more than the
    true ones, so the press stops early rather than late. A soft object dents the dome less.
    """
    dome = dome_of(sensor)
    a, b = dome.points[:, 0].max(), dome.points[:, 1].max()
    at = np.stack(np.meshgrid(np.arange(-a, a, _GRID), np.arange(-b, b, _GRID), indexing="ij"), axis=-1).reshape(-1, 2)
    over = dome.heights(at)
    depth = np.linspace(0.0, dome.height, 65)
    cut = np.maximum(over[None] - (dome.height - depth)[:, None], 0.0)
    area, gone = (cut > 0.0).sum(axis=1) * _GRID**2, cut.sum(axis=1) * _GRID**2
    spec = sensor.spec
    pressure = np.full(len(depth), sensor.pressure)
    if spec.sealed:
        inside = float(sensor.mesh.volume[0]) + sensor.dead_volume
        pressure = (spec.ambient_pressure + sensor.pressure) * (inside / np.maximum(inside - gone,
                                                                                    1e-3 * inside)) ** spec.gamma - spec.ambient_pressure
    push = pressure * area
    if push[-1] <= force:
        return float("inf")
    return float(np.interp(force, np.maximum.accumulate(push), depth))


def mount_path(spec: TouchSpec, a: Aim) -> np.ndarray:
    """Poses (T, 4, 4) of the mount: as a rigid probe's, but the way out ends where the way in had its first reading,
    still in contact.

    Two soft bodies that stuck part somewhere near first contact, and there is no force left to measure an imbalance by.
    """
    poses = touch_path(spec, _LEADS, a.contact, a.axis, depth=a.depth)
    free, inward, _, out = spec.frames
    if out:
        back = poses[free:free + inward][::-1][1:] if inward > 1 else poses[free:free + 1]
        poses[-out:] = back[np.linspace(-1, len(back) - 1, out + 1).round().astype(int)[1:]]
    return poses


def options(tier: str, device: str) -> SolverOptions:
    """Solver limits of a tier, without the clock: what a frame may cost is counted in iterations, so that the bits do
    not depend on the machine's load.

    A frame on its way takes some 50 conjugate gradients, seldom 100; what has not arrived after `_PATIENCE` seldom
    does, and one such touch would hold up its batch.
    Of 900 frames of `shoes-punyo-mini` 11 take more than `_STEPS` Newton iterations, and 6 of these arrive nowhere.
    """
    limits = dataclasses.replace(tiers.options(tier), seconds=1e9, cg_frame=_PATIENCE)
    return limits if device == "cpu" else dataclasses.replace(limits, newton_frame=_STEPS)


def touch_all(scene: Scene, spec: TouchSpec, model: Model, sensor: BubbleModel, aims: list[Aim], *,
              options: SolverOptions, device: str,
              progress: Callable[[int], None] | None = None) -> list[Touch]:
    """Simulate touches, `BATCH` at a time.

    Args:
        progress: called with the number of frames newly done.
    """
    assert scene.sensor is not None
    most = BATCH[device.split(":")[0]]
    batch = -(-len(aims) // -(-len(aims) // most))  # as even as can be
    camera = None
    if scene.sensor.camera is not None:
        width, height = scene.sensor.camera
        camera = BubbleCamera(width, height, BubbleCamera.focal * width / CAMERA[0])
    out: list[Touch] = []
    for start in range(0, len(aims), batch):
        part = aims[start:start + batch]
        poses = np.stack([mount_path(spec, a) for a in part], axis=1)
        solver = CoupledSolver(model, sensor, friction=scene.sensor.friction, device=device, options=options)
        width = len(part)
        frames = solver.run(poses, keep=True, progress=None if progress is None else lambda _, k=width: progress(k))
        for k, a in enumerate(part):
            position, force = (np.stack([x[..., k] for x in kept])
                               for kept in (solver.sensor_position, solver.sensor_force))
            out.append(_record(a, poses[:, k], frames, k, sensor, position, force, np.stack(solver.pressure)[:, k],
                               camera, device))
    return out


def _record(a: Aim, poses: np.ndarray, frames: Frames, k: int, sensor: BubbleModel, position: np.ndarray,
            force: np.ndarray, pressure: np.ndarray,
            camera: BubbleCamera | None, device: str) -> Touch:
    finite = np.isfinite(frames.force[:,
                                      k]).all(axis=1) & np.isfinite(position).all(axis=(1,
                                                                                        2)) & np.isfinite(force).all(axis=(1, 2)) & np.isfinite(pressure)
    found = frames.converged[:, k] & finite
    converged = found & (frames.force_balance[:, k] <= _BALANCE)
    return Touch(
        time=times(len(poses)), mount_pose=poses, axis=a.axis, target=a.target, normal=a.normal,
        force=frames.force[:, k], reaction=frames.reaction[:, k], converged=converged, residual=frames.residual[:, k],
        iterations=frames.iterations[:, k],
                 touched=bool((np.linalg.norm(np.nan_to_num(frames.force[:, k]), axis=1) > 0.0).any()),
        reason=np.where(converged, 0, np.where(found, len(REASONS), np.maximum(frames.reason[:, k], 1))),
                 reason_names=REASONS, audit=audit(frames, k),
        **touch_fields(sensor, position, force, pressure, poses, converged=converged, camera=camera, device=device))
