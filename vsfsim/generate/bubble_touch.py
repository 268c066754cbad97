"""Touches by an air-filled bubble: where its mount aims, how far it goes, and what both bodies answer.

As a rigid probe's, the mount comes in along the normal that the camera sees, or tilted from it; its +z leads. The apex
of the free dome points at the target; depth counts from where the dome, undented, first meets the object at rest, which
may be beside the apex. Against rigid obstacles the solver works in the mount frame, where they move; with an object
both bodies find one equilibrium (`CoupledSolver`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.bubble import CAMERA
from vsfsim.core.dome import Dome
from vsfsim.core.errors import SceneError
from vsfsim.core.rotation import rotation_matrix
from vsfsim.core.scene import Scene, TouchSpec
from vsfsim.core.shape import Plane
from vsfsim.data.records import Touch, View
from vsfsim.generate.aim import BLOCKED, Aim, draw_aims, starts, surface_samples, tilted
from vsfsim.generate.effector import Drawing
from vsfsim.generate.record import batches, recorded
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.elements import gas
from vsfsim.physics.model import Model
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import touch_path, turn_to
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


def tier_for(scene: Scene, asked: str | None) -> str:
    """The tier of the object under a bubble: as `tiers.choose`, at least ``fem-coarse``.

    Raises:
        SceneError: a tier was asked for that a bubble cannot press.
    """
    chosen = tiers.choose(scene, asked)
    if tiers.TIERS[chosen].nonlinear:
        return chosen
    if (asked or scene.required_object.tier) != "auto":
        raise SceneError(f"{scene.source}: tier '{chosen}' cannot be touched by a [sensor], which "
                         "bends far; use 'fem-coarse' or finer.")
    return "fem-coarse"


def dome_of(model: BubbleModel) -> Dome:
    """The free dome on the read-out mesh: what a dataset says of its sensor's shape."""
    seen = readout_of(model)
    return Dome.of(seen.positions(model.mesh.points[None])[0], seen.readout.faces)


def draw_dome(scene: Scene) -> Drawing:
    """The free dome of a scene without an object, and its figures."""
    spec = scene.required_sensor
    model = build_bubble(spec, where=f"{scene.source} [sensor]")
    mesh, rate = model.mesh, gas.at_rest(model.blocks[2])[2]
    lines = [f"a bubble of {len(mesh.points)} nodes and {len(mesh.faces)} triangles, mean edge "
             f"{1e3 * model.element_size:.2f} mm; read-out mesh of {len(model.read_out.flat)} "
             f"nodes, {len(model.read_out.faces)} triangles, {len(model.read_out.rim)} on the rim",
             f"  rim            {2e3 * spec.semi_axes[0]:.1f} x {2e3 * spec.semi_axes[1]:.1f} mm, "
             f"E h {spec.modulus:.0f} N/m, pre-stretch {spec.pre_stretch:g}",
             "  free dome      "
             f"apex {1e3 * mesh.points[:, 2].max():.2f} mm, volume {1e6 * mesh.volume[0]:.2f} mL, at "
             f"{model.spec.gauge_pressure:.0f} Pa gauge",
             f"  gas            {1e6 * spec.gas_volume:.1f} mL, gamma {spec.gamma:g}, sealed: "
             f"dp/dV {-1e-9 * rate:.3f} kPa/mL"]
    surface = Surface(mesh.points, mesh.faces, np.zeros(len(mesh.faces), np.int64), None, mesh.points)
    return Drawing(surface, None, "free dome", tuple(lines))


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
    spec, inside = sensor.spec, float(sensor.mesh.volume[0]) + sensor.dead_volume
    squeezed = inside / np.maximum(inside - gone, 1e-3 * inside)
    pressure = (spec.ambient_pressure + spec.gauge_pressure) * squeezed**spec.gamma - spec.ambient_pressure
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


@dataclass(frozen=True)
class Solved:
    """Touches that were solved together: B touches of T frames."""

    scene: Scene
    sensor: BubbleModel
    object: Model | None
    """What is touched; None for the scene's obstacles."""
    aims: Sequence[Aim]
    mount: np.ndarray
    """Mount to world (T, B, 4, 4) [m]."""
    frames: Frames
    """Forces are in the world, that of all bodies together is that on the sensor."""
    position: np.ndarray
    """Of the skin's nodes, world (T, n, 3, B) [m]."""
    force: np.ndarray
    """Contact force on them, world (T, n, 3, B) [N]."""
    pressure: np.ndarray
    """Gauge (T, B) [Pa]."""
    volume: np.ndarray
    """Under the skin (T, B) [m^3]."""
    moved: np.ndarray | None
    """Displacements of the object's nodes (T, N, 3, B) [m]; None without an object."""

    def in_mount(self, k: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Nodes of the skin and the contact force on them in touch k, mount frame (T, n, 3) [m, N]."""
        turn, at = self.mount[:, k, :3, :3], self.mount[:, k, None, :3, 3]
        return (np.einsum("tji,tnj->tni", turn, self.position[..., k] - at),
                np.einsum("tji,tnj->tni", turn, self.force[..., k]))

    def wrench(self, k: int = 0) -> np.ndarray:
        """Of the contact at the mount's origin in touch k, mount frame: force [N] and moment [N m] (T, 6)."""
        position, force = self.in_mount(k)
        return np.concatenate([force.sum(axis=1), np.cross(position, force).sum(axis=1)], axis=1)

    def touches(self, device: str = "cpu") -> list[Touch]:
        """The records."""
        spec, camera = self.scene.required_sensor, None
        if spec.camera is not None:
            width, height = spec.camera
            camera = BubbleCamera(width, height, BubbleCamera.focal * width / CAMERA[0])
        return [self._touch(a, k, camera, device) for k, a in enumerate(self.aims)]

    def _touch(self, a: Aim, k: int, camera: BubbleCamera | None, device: str) -> Touch:
        frames, position, force, pressure = self.frames, self.position[..., k], self.force[..., k], self.pressure[:, k]
        poses, own = self.mount[:, k], frames.force[:, k]
        finite = (np.isfinite(own).all(axis=1) & np.isfinite(position).all(axis=(1, 2))
                  & np.isfinite(force).all(axis=(1, 2)) & np.isfinite(pressure))
        touch = recorded(frames, k, poses, own, found=finite, axis=a.axis, target=a.target, normal=a.normal,
                         touched=bool((np.linalg.norm(np.nan_to_num(own), axis=1) > 0.0).any()))
        return dataclasses.replace(touch, **touch_fields(
            self.sensor, position, force, pressure, poses, converged=touch.converged, camera=camera, device=device))


def solve(scene: Scene, model: Model | None, sensor: BubbleModel, aims: Sequence[Aim], *, options: SolverOptions,
          device: str, progress: Callable[[int], None] = lambda _: None) -> Iterator[Solved]:
    """Solve touches, `BATCH` at a time at most.

    Args:
        scene: with ``[sensor]``; with ``[touches]`` where an aim has no path of its own.
        model: the object; None for the scene's obstacles, which are touched one touch at a time.
        sensor: the bubble.
        aims: the touches.
        options: of the solver.
        device: Warp device.
        progress: called with the number of frames newly done.
    """
    for some in batches(len(aims), 1 if model is None else BATCH[device.split(":")[0]]):
        part = aims[some]
        mount = np.stack([mount_path(scene.required_touches, a) if a.path is None else a.path for a in part], axis=1)
        first = starts(scene, part, mount[0])
        width = len(part)
        tell = lambda _, k=width: progress(k)  # noqa: E731
        if model is None:
            yield _on_obstacles(scene, sensor, part, mount, first, options, device, tell)
            continue
        solver = CoupledSolver(model, sensor, friction=scene.required_sensor.friction, device=device, options=options)
        frames = solver.run(mount, start=first, keep=True, progress=tell)
        moved = np.stack(solver.history)[:, :3 * len(model.mesh.points)]
        yield Solved(scene, sensor, model, part, mount, frames, np.stack(solver.sensor_position),
                     np.stack(solver.sensor_force), np.stack(solver.pressure),
                     np.stack(solver.volume), moved.reshape(len(mount), -1, 3, len(part)))


def _on_obstacles(scene: Scene, sensor: BubbleModel, aims: Sequence[Aim], mount: np.ndarray,
                  first: np.ndarray, options: SolverOptions, device: str,
                  progress: Callable[[int], None]) -> Solved:
    solver, gas = Solver(sensor, scene.bodies, friction=scene.frictions, device=device, options=options), []

    def done(frames: int) -> None:
        assert solver.elasticity.pressure is not None and solver.elasticity.volume is not None  # of a body with gas
        gas.append((solver.elasticity.pressure.numpy().copy(), solver.elasticity.volume.numpy().copy()))
        progress(frames)

    frames = solver.run(in_mount(scene, mount[:, 0])[:, None], start=in_mount(scene, first), keep=True, progress=done)
    turn, at = mount[:, 0, :3, :3], mount[:, 0, None, :3, 3]

    def world(vectors: np.ndarray) -> np.ndarray:
        return np.einsum("tij,t...j->t...i", turn, vectors)

    at_rest = sensor.mesh.points
    position = at_rest + np.stack([u[:, 0].reshape(-1, 3) for u in solver.history])
    push = np.stack([f[..., 0] for f in solver.surface_force])
    frames = dataclasses.replace(frames, force=-world(frames.force), reaction=world(frames.reaction),
                                 body_force=world(frames.body_force))
    return Solved(scene, sensor, None, aims, mount, frames, (world(position) + at)[..., None], world(push)[..., None],
                  np.stack([p for p, _ in gas]), np.stack([v for _, v in gas]), None)


def in_mount(scene: Scene, mount: np.ndarray) -> np.ndarray:
    """Poses of the obstacles in the mount frame (T, K, 4, 4) for poses of the mount in the world (T, 4, 4)."""
    stand = np.tile(np.eye(4), (len(scene.obstacles), 1, 1))
    for pose, body in zip(stand, scene.obstacles, strict=True):
        pose[:3, :3], pose[:3, 3] = rotation_matrix(body.rotation), body.position
    turn, at = mount[:, None, :3, :3], mount[:, None, :3, 3]
    out = np.tile(np.eye(4), (len(mount), len(stand), 1, 1))
    out[..., :3, :3] = np.swapaxes(turn, -1, -2) @ stand[None, :, :3, :3]
    out[..., :3, 3] = np.einsum("...ji,...j->...i", turn, stand[None, :, :3, 3] - at)
    return out
