"""The air-filled bubble of a scene's ``[sensor] kind = "bubble"``: where its mount aims, how far it goes, and what both
bodies answer.

As a rigid probe's, the mount comes in along the normal that the camera sees, or tilted from it; its +z leads. The apex
of the free dome points at the target; depth counts from where the dome, undented, first meets the object at rest, which
may be beside the apex.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.bubble import CAMERA, Bubble
from vsfsim.core.dome import Dome
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile, TouchSpec
from vsfsim.core.shape import Plane
from vsfsim.data.records import ObjectView, Touch, View
from vsfsim.generate.aim import BLOCKED, Aim, draw_aims, starts, surface_samples, tilted
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.press_result import MeshSeries, PressRequest, PressResult
from vsfsim.generate.presses import bubble as one_press
from vsfsim.generate.record import audit, verdict
from vsfsim.generate.solid import Manner, Subject, batches, draw_solid, prepare
from vsfsim.generate.trade.audit import audited
from vsfsim.generate.truth import truth_of
from vsfsim.generate.workers import make_each
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.bubble.shape import punyo_rms, stretches
from vsfsim.physics.contact.pair.response import SENSOR_NODES
from vsfsim.physics.elements import gas
from vsfsim.physics.model import Model
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.kernels import coupled_kernels
from vsfsim.robot.path import times, touch_path, turn_to
from vsfsim.sensing.bubble import readout_of
from vsfsim.sensing.bubble_camera import BubbleCamera
from vsfsim.sensing.bubble_touch import touch_fields
from vsfsim.sensing.surface import Surface

BATCH = {"cpu": 9, "cuda": 256}  # touches that are solved together; part of what fixes the bits
LEADING = Plane()  # a sensor's +z leads, as a plane's does
CG_FRAME = 200  # conjugate gradients of a touch in one frame
# Newton iterations of a touch in one frame on a GPU: there hundreds of touches wait for the last one, whose steps cost
# as much as those of all
NEWTON_FRAME = 30
_GRID = 1e-3  # distance of the points at which the dome is cut by a wall [m]


class BubbleEffector:
    """A soft-bubble sensor on a mount; see `vsfsim.generate.effector.Effector`."""

    table = "sensor"
    options: tuple[str, ...] = ()

    def check(self, scene: Scene, tier: str | None) -> str:
        """The tier of the object: as `tiers.choose`, at least ``fem-coarse``.

        Raises:
            SceneError: a tier that a bubble cannot press, too many nodes, a bubble that cannot be inflated, or
                a depth of more than the dome's height.
        """
        sensor, depth = scene.required_sensor, scene.required_touches.depth
        chosen = tier_for(scene, tier)
        if sensor.nodes > SENSOR_NODES:
            raise SceneError(f"{scene.source} [sensor]: nodes is {sensor.nodes}; against an object up to "
                             f"{SENSOR_NODES} are allowed, since the skin's compliance is kept whole. Give fewer.")
        height = float(build_bubble(sensor, where=f"{scene.source} [sensor]").mesh.points[:, 2].max())
        if depth > height:
            raise SceneError(f"{scene.source} [touches]: depth is {depth:g} m, but the free dome of the "
                             f"[sensor] is {height:.4f} m high; its rim would go into the object. Give less.")
        return chosen

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Pressure, moment and the read-out mesh; the solved mesh and the camera's pictures if the scene asks."""
        sensor = scene.required_sensor
        out = ("min_det_f", "pressure", "rest_pressure", "moment", "node_position", "node_force", "node_rest",
               "node_reference", "node_triangles")
        fine = ("fine_position", "fine_force", "fine_rest", "fine_triangles") if sensor.fine else ()
        return (*out, *fine, *(("inside_depth", "inside_rgb") if sensor.camera else ()))

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the coupled solver and of the camera inside; its oracle VSF sticks to the dome without a kernel."""
        from vsfsim.sensing import render_bubble

        camera = [render_bubble.inside_kernel] if scene.required_sensor.camera else []
        own = [] if scene.object is None else tiers.elements(scene, tier_for(scene, None))
        return [*coupled_kernels([*own, ("triangle", ""), ("hinge", ""), ("gas", "")]), *camera]

    def make_view(self, job: Job, *, device: str, progress: Callable[[int], None] | None = None) -> ObjectView:
        """Build, look, aim along the normals or tilted from them, press."""
        subject = prepare(job, device=device)
        aims = self.aim(subject, device=device)
        touches = audited(self, subject, aims, device=device, progress=progress)
        dome = dome_of(_sensor_of(subject))
        truth = truth_of(subject.model, subject.view, touches, [dome] * len(touches), friction=float("inf"),
                         device=device)
        return subject.record(dome, touches, truth)

    def manner(self, scene: Scene) -> Manner:
        """With the short semi-axis of its rim, at the tiers that bend far."""
        sensor = scene.required_sensor
        able = tuple(name for name, tier in tiers.TIERS.items() if tier.nonlinear)
        return Manner(sensor.semi_axes[1], able if scene.object is not None else (), sensor.nodes)

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return aim(subject.scene, subject.model, _sensor_of(subject), subject.view, subject.stream)

    def touch(self, subject: Subject, aims: list[Aim], *, device: str, progress: Callable[[int], None] | None = None,
              paths: Sequence[np.ndarray] = ()) -> list[Touch]:
        """See `touch_all`."""
        return touch_all(subject.scene, subject.model, _sensor_of(subject), aims,
                         options=solver_options(subject.limits(), device), device=device, progress=progress,
                         paths=paths)

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
        """Each view in a process of its own."""
        return make_each(jobs, device=device, workers=workers)

    def press(self, loaded: SceneFile, request: PressRequest) -> PressResult:
        """See `vsfsim.generate.presses.bubble`."""
        return one_press.press(loaded, request)

    def refine(self, loaded: SceneFile, request: PressRequest, meshes: int) -> MeshSeries:
        """See `vsfsim.generate.presses.bubble`."""
        return one_press.refine(loaded, request, meshes)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object, or the free dome where there is none."""
        return _draw_dome(scene) if scene.object is None else draw_solid(scene, seed)


EFFECTOR = BubbleEffector()


def _sensor_of(subject: Subject) -> BubbleModel:
    return _built(subject.scene.required_sensor, str(subject.scene.source), subject.job.cache)


@functools.lru_cache(maxsize=1)
def _built(spec: Bubble, source: str, cache: Path | None) -> BubbleModel:
    return build_bubble(spec, where=f"{source} [sensor]", cache=cache)


def _draw_dome(scene: Scene) -> Drawing:
    spec = scene.required_sensor
    model = build_bubble(spec, where=f"{scene.source} [sensor]")
    mesh = model.mesh
    apex = int(mesh.points[:, 2].argmax())
    largest, least = stretches(model)[(mesh.faces == apex).any(axis=1)].mean(axis=0)
    rate = gas.at_rest(model.blocks[2])[2]
    lines = [f"a bubble of {len(mesh.points)} nodes and {len(mesh.faces)} triangles, mean edge "
             f"{1e3 * model.element_size:.2f} mm; "
             f"read-out mesh of {len(model.read_out.flat)} nodes, {len(model.read_out.faces)} triangles, "
             f"{len(model.read_out.rim)} on the rim",
             f"  rim            {2e3 * spec.semi_axes[0]:.1f} x {2e3 * spec.semi_axes[1]:.1f} mm, E h "
             f"{spec.modulus:.0f} N/m, pre-stretch {spec.pre_stretch:g}",
             f"  free dome      apex {1e3 * mesh.points[apex, 2]:.2f} mm, volume {1e6 * mesh.volume[0]:.2f} mL, at "
             f"{model.pressure:.0f} Pa gauge; stretch at the apex {least:.3f} x {largest:.3f}",
             f"  gas            {1e6 * spec.gas_volume:.1f} mL, gamma {spec.gamma:g}, "
             + (f"sealed: dp/dV {-1e-9 * rate:.3f} kPa/mL" if spec.sealed else "open")]
    if spec.semi_axes == type(spec)().semi_axes:
        lines.append(f"  height map     rms {1e3 * punyo_rms(model):.2f} mm from h = 30.89 mm (1 - rho^2)^0.763, a "
                     f"real Punyo's")
    surface = Surface(mesh.points, mesh.faces, np.zeros(len(mesh.faces), np.int64), None, mesh.points)
    return Drawing(surface, None, "free dome", tuple(lines))


def tier_for(scene: Scene, asked: str | None) -> str:
    """The tier of the object under a bubble: as `tiers.choose`, at least ``fem-coarse``.

    Raises:
        SceneError: a tier was asked for that a bubble cannot press.
    """
    chosen = tiers.choose(scene, asked)
    if tiers.TIERS[chosen].nonlinear:
        return chosen
    if (asked or scene.required_object.tier) != "auto":
        raise SceneError(f"{scene.source}: tier '{chosen}' cannot be touched by a [sensor], which bends far; use "
                         f"'fem-coarse' or finer.")
    return "fem-coarse"


def dome_of(model: BubbleModel) -> Dome:
    """The free dome on the read-out mesh: what a dataset says of its sensor's shape."""
    seen = readout_of(model)
    return Dome.of(seen.positions(model.mesh.points[None])[0], seen.readout.triangles)


def aim(scene: Scene, model: Model, sensor: BubbleModel, view: View,
        stream: Callable[[int], np.random.Generator]) -> list[Aim]:
    """The touches of a view, each along the visible normal or tilted from it.

    A target cannot be reached where another part of the object is more than `BLOCKED` in the way, or the table (z < 0)
    is.

    Args:
        scene: with ``[touches]``.
        model: the object.
        sensor: the bubble.
        view, stream: as of `draw_aims`.

    Raises:
        SceneError: as `draw_aims`.
    """
    spec, samples, dome = scene.required_touches, surface_samples(model), dome_of(sensor)
    most = depth_at(sensor, spec.force_limit)

    def reach(_: int, target: np.ndarray, normal: np.ndarray, rng: np.random.Generator) -> Aim | None:
        axis = -normal if spec.tilt == 0.0 else tilted(-normal, spec.tilt, rng)
        depth, approach = min(spec.draw_depth(rng), most), spec.draw_approach(rng)
        contact = first_contact(dome, samples, target, axis)
        free = _reachable(dome, contact, target, axis, depth, approach)
        return Aim(target, normal, axis, contact, depth, approach) if free else None

    return draw_aims(scene, view, stream, reach,
                     unreachable="by the [sensor] without meeting the table or another part first; use a smaller "
                                 "bubble, approach or depth, or an object with more free surface.")


def first_contact(dome: Dome, samples: np.ndarray, target: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The mount's origin (3,) [m] when the free dome, coming in along ``axis`` with its apex over ``target``, first
    meets a body.

    Args:
        dome: the sensor.
        samples: points that cover the body's surface (k, 3) [m].
        target: a point (3,) [m].
        axis: unit direction of the press (3,).
    """
    local = (samples - target) @ turn_to(axis, LEADING)
    # with the apex over it, the target itself is met at the latest: no point beyond its plane comes before it
    before = local[local[:, 2] < 0.0]
    gone = dome.heights(before[:, :2]) - before[:, 2]
    return target - max(float(gone.max(initial=-np.inf)), dome.height) * axis


def _reachable(dome: Dome, contact: np.ndarray, target: np.ndarray, axis: np.ndarray, depth: float,
               approach: float) -> bool:
    if (target - contact) @ axis - dome.height > BLOCKED:
        return False
    low = float((dome.points @ turn_to(axis, LEADING).T)[:, 2].min())
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
        squeezed = inside / np.maximum(inside - gone, 1e-3 * inside)
        pressure = (spec.ambient_pressure + sensor.pressure) * squeezed**spec.gamma - spec.ambient_pressure
    push = pressure * area
    if push[-1] <= force:
        return float("inf")
    return float(np.interp(force, np.maximum.accumulate(push), depth))


def mount_path(spec: TouchSpec, a: Aim) -> np.ndarray:
    """Poses (T, 4, 4) of the mount: as a rigid probe's, but the way out ends where the way in had its first reading,
    still in contact.

    Two soft bodies that stuck part somewhere near first contact, and there is no force left to measure an imbalance by.
    """
    poses = touch_path(spec, LEADING, a.contact, a.axis, depth=a.depth, approach=a.approach)
    free, inward, _, out = spec.frames
    if out:
        back = poses[free:free + inward][::-1][1:] if inward > 1 else poses[free:free + 1]
        poses[-out:] = back[np.linspace(-1, len(back) - 1, out + 1).round().astype(int)[1:]]
    return poses


def solver_options(own: SolverOptions, device: str) -> SolverOptions:
    """Solver limits without the clock: what a frame may cost is counted in iterations, so that the bits do
    not depend on the machine's load.

    A frame that converges takes about 50 conjugate gradients, seldom 100. One that has not converged after `CG_FRAME`
    seldom does, and it would hold up its batch. Of 900 frames of `shoes-punyo-mini` 11 take more than `NEWTON_FRAME`
    Newton iterations, and 6 of these do not converge at all.
    """
    limits = dataclasses.replace(own, seconds=1e9, cg_frame=CG_FRAME)
    return limits if device == "cpu" else dataclasses.replace(limits, newton_frame=NEWTON_FRAME)


def touch_all(scene: Scene, model: Model, sensor: BubbleModel, aims: list[Aim], *, options: SolverOptions, device: str,
              progress: Callable[[int], None] | None = None, paths: Sequence[np.ndarray] = ()) -> list[Touch]:
    """Simulate touches, `BATCH` at a time at most.

    Args:
        scene: with ``[touches]`` and ``[sensor]``.
        model: the object.
        sensor: the bubble.
        aims: the touches.
        options: of the solver.
        device: Warp device.
        progress: called with the number of frames newly done.
        paths: of the mount (T, 4, 4) of each touch; () for those of the aims.
    """
    spec, camera = scene.required_sensor, None
    paths = paths or [mount_path(scene.required_touches, a) for a in aims]
    if spec.camera is not None:
        width, height = spec.camera
        camera = BubbleCamera(width, height, BubbleCamera.focal * width / CAMERA[0])
    out: list[Touch] = []
    for some in batches(len(aims), BATCH[device.split(":")[0]]):
        part, poses = aims[some], np.stack(paths[some], axis=1)
        solver = CoupledSolver(model, sensor, friction=spec.friction, device=device, options=options)
        width = len(part)
        frames = solver.run(poses, start=starts(scene.required_touches, part, poses[0]), keep=True,
                            progress=None if progress is None else lambda _, k=width: progress(k))  # type: ignore[misc]
        for k, a in enumerate(part):
            position, force = (np.stack([x[..., k] for x in frame])
                               for frame in (solver.sensor_position, solver.sensor_force))
            out.append(_record(a, poses[:, k], frames, k, sensor, position, force, np.stack(solver.pressure)[:, k],
                               camera, device))
    return out


def _record(a: Aim, poses: np.ndarray, frames: Frames, k: int, sensor: BubbleModel, position: np.ndarray,
            force: np.ndarray, pressure: np.ndarray, camera: BubbleCamera | None, device: str) -> Touch:
    finite = (np.isfinite(frames.force[:, k]).all(axis=1) & np.isfinite(position).all(axis=(1, 2))
              & np.isfinite(force).all(axis=(1, 2)) & np.isfinite(pressure))
    found = verdict(frames.converged[:, k] & finite, frames.force_balance[:, k], np.maximum(frames.reason[:, k], 1))
    return Touch(
        time=times(len(poses)), mount_pose=poses, axis=a.axis, target=a.target, normal=a.normal,
        force=frames.force[:, k], reaction=frames.reaction[:, k], residual=frames.residual[:, k],
        iterations=frames.iterations[:, k],
        touched=bool((np.linalg.norm(np.nan_to_num(frames.force[:, k]), axis=1) > 0.0).any()), audit=audit(frames, k),
        **found, **touch_fields(sensor, position, force, pressure, poses, converged=found["converged"], camera=camera,
                                device=device))
