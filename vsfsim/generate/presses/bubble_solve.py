"""Equilibria of an air-filled bubble that is pressed on a deformable object or on rigid bodies.

The mount's origin follows ``[press]``, its +z leads. Against rigid bodies the solver works in the mount frame, where
the obstacles move; with an object both bodies find one equilibrium (`CoupledSolver`).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import cast

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.rigid import PressSpec
from vsfsim.core.rotation import rotation_matrix
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Plane
from vsfsim.generate.aim import clearance
from vsfsim.generate.press_result import PressRequest
from vsfsim.generate.presses.verdict import direction
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble, wishes
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.mesh.membrane import TriangleMesh
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.coupled import CoupledSolver, free_way
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.kernels import coupled_kernels, solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import press_path

_INTO_HOUSING = 1e-4  # how far an obstacle may reach into it [m]
OPTIONS = SolverOptions(tolerance=5e-4)
"""As tier fem: with friction, a smaller residual is not always reached where a point is at the limit of contact."""


@dataclass(frozen=True)
class Solved:
    """The frames of a bubble's press; positions and forces in the mount frame unless said."""

    scene: Scene
    path: PressSpec
    """Of the mount's origin."""
    model: BubbleModel
    mount: np.ndarray
    """Mount to world (T, 4, 4) [m]."""
    frames: Frames
    gap: float
    """Way of the mount to first contact [m]."""
    position: np.ndarray
    """Of the membrane's nodes (T, n, 3) [m]."""
    push: np.ndarray
    """Contact force on the nodes (T, n, 3) [N]."""
    pressure: np.ndarray
    """Gauge (T,) [Pa]."""
    volume: np.ndarray
    """Under the membrane (T,) [m^3]."""
    reaction: np.ndarray
    """Of the mount on the sensor, world (T, 3) [N]."""
    body_force: np.ndarray
    """On each body, world (T, K, 3) [N]."""
    bodies: tuple[str, ...]
    """Names (K,)."""
    friction: tuple[float, ...]
    """Coulomb coefficient of each body (K,) [-]."""
    tolerance: float
    """Of the residual [-]."""
    notes: tuple[str, ...] = ()
    object: Model | None = None
    """The deformable body that is pressed."""
    moved: np.ndarray | None = None
    """Displacements of its nodes, world (T, N, 3) [m]."""
    build_seconds: float = 0.0
    """Spent on inflation and factorisation [s]."""

    @property
    def full(self) -> int:
        """Number of the frame of full depth."""
        return self.path.inward - 1

    @property
    def way(self) -> np.ndarray:
        """Way of the mount along the first part of its path (T,) [m]."""
        return (self.mount[:, :3, 3] - np.array(self.path.start)) @ direction(self.path)

    @property
    def wrench(self) -> np.ndarray:
        """Of the contact at the mount's origin, mount frame: force [N] and moment [N m] (T, 6)."""
        return np.concatenate([self.push.sum(axis=1), np.cross(self.position, self.push).sum(axis=1)], axis=1)


def solve(scene: Scene, request: PressRequest) -> Solved:
    """Solve the ``[press]`` of a scene with a ``[sensor]`` and an object, or obstacles.

    Args:
        scene: concrete.
        request: tier, of the object; seed; device; cache; progress.

    Raises:
        SceneError: no path, both an object and obstacles, a tier that a sensor cannot press, or something that cannot
            be built.
    """
    spec, sensor = scene.press, scene.required_sensor
    if spec is None:
        raise SceneError(f"{scene.source}: a scene with a [sensor] needs a [press]: the path of the middle of its rim, "
                         f"e.g. from = [0, 0, 0.05], to = [0, 0, 0.02].")
    if scene.object is not None and scene.obstacles:
        raise SceneError(f"{scene.source}: a [sensor] presses an [object] or [[obstacles]]; this scene has both. Take "
                         f"one of them out.")
    if scene.object is None and request.tier is not None:
        raise SceneError(f"--tier {request.tier}: this scene has a [sensor] and no [object], and tiers are of objects; "
                         f"the sensor's mesh is set by nodes in [sensor]. Leave --tier out.")
    began = time.perf_counter()
    where = f"{scene.source} [sensor]"
    model = build_bubble(sensor, where=where, cache=request.cache)
    mount = press_path(spec, Plane())  # a plane's +z leads, as a sensor's does
    if scene.object is not None:
        return _on_object(scene, spec, model, mount, request, time.perf_counter() - began)
    poses = in_mount(scene, mount)
    notes: tuple[str, ...] = ()
    finer = wishes(model.mesh.points, model.element_size, RigidBodies(scene.bodies), poses, sensor.contact_edge)
    if finer:
        model = build_bubble(sensor, finer=finer, where=where, cache=request.cache)
        notes = (f"{sensor.nodes} nodes became {len(model.mesh.points)}: triangles are smaller where bodies touch; "
                 f"contact_edge in [sensor] says how small.",)
    return _on_obstacles(scene, spec, model, mount, poses, request, time.perf_counter() - began, notes)


def _on_obstacles(scene: Scene, path: PressSpec, model: BubbleModel, mount: np.ndarray, poses: np.ndarray,
                  request: PressRequest, built: float, notes: tuple[str, ...]) -> Solved:
    _before_housing(scene, model, poses)
    compile_kernels(solver_kernels(elements_of(model.blocks)), request.device, progress=request.progress)
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = mount[0, :3, :3], path.start
    axis = direction(path)
    begin = in_mount(scene, first[None])
    gap = min(clearance(model, shape, pose, -first[:3, :3].T @ axis)
              for shape, pose in zip(scene.bodies, begin[0], strict=True))
    solver = Solver(model, scene.bodies, friction=scene.frictions, device=request.device,
                    options=request.limited(OPTIONS))
    pressure: list[float] = []
    volume: list[float] = []

    def done(frames: int) -> None:
        assert solver.elasticity.pressure is not None and solver.elasticity.volume is not None  # of a body with gas
        pressure.append(float(solver.elasticity.pressure.numpy()[0]))
        volume.append(float(solver.elasticity.volume.numpy()[0]))
        if request.progress is not None:
            request.progress(frames, len(poses), "frames")

    frames = solver.run(poses[:, None], start=begin, keep=True, progress=done)

    def world(force: np.ndarray) -> np.ndarray:
        return np.einsum("tij,t...j->t...i", mount[:, :3, :3], force)

    return Solved(scene, path, model, mount, frames, gap,
                  model.mesh.points + np.stack([u[:, 0].reshape(-1, 3) for u in solver.history]),
                  np.stack([f[..., 0] for f in solver.surface_force]), np.array(pressure), np.array(volume),
                  world(frames.reaction[:, 0]), world(frames.body_force[:, 0]),
                  tuple(f"obstacle {i + 1}" for i in range(len(scene.obstacles))), scene.frictions, OPTIONS.tolerance,
                  notes, build_seconds=built)


def _before_housing(scene: Scene, model: BubbleModel, poses: np.ndarray) -> None:
    """Refuse obstacles that reach into the housing: the rim, and a rigid floor `Bubble.chamber` behind its plane.

    Args:
        poses: of the obstacles in the mount frame (T, K, 4, 4).

    Raises:
        SceneError: an obstacle is behind the rim, or behind the floor within it.
    """
    bodies, chamber = RigidBodies(scene.bodies), model.spec.chamber
    plate = np.column_stack([model.flat, np.full(len(model.flat), -chamber)])
    plate[cast(TriangleMesh, model.mesh).rim, 2] = 0.0
    for t, frame in enumerate(poses):
        for k, pose in enumerate(frame):
            depth = -float(bodies.distance(k, (plate - pose[:3, 3]) @ pose[:3, :3]).min())
            if depth > _INTO_HOUSING:
                raise SceneError(f"{scene.source}: in frame {t} of [press] obstacle {k + 1} is {1e3 * depth:.2g} mm "
                                 f"behind the plane of the sensor's rim or the floor of its chamber, "
                                 f"{1e3 * chamber:g} mm behind it. The free dome is "
                                 f"{1e3 * float(model.mesh.points[:, 2].max()):.1f} mm high; let the path end before, "
                                 f"or give the depth of the chamber, chamber in [sensor].")


def _on_object(scene: Scene, path: PressSpec, model: BubbleModel, mount: np.ndarray, request: PressRequest,
               built: float) -> Solved:
    friction = scene.required_sensor.friction
    chosen = tiers.choose(scene, request.tier)
    if not tiers.TIERS[chosen].nonlinear:
        if request.tier is not None or scene.required_object.tier != "auto":
            raise SceneError(f"{scene.source}: tier {chosen!r} cannot be pressed by a [sensor], which bends far; tier "
                             f"= \"fem-coarse\" or finer would do.")
        chosen = "fem-coarse"
    body = tiers.build(scene, chosen, seed=request.seed, cache=request.cache)
    compile_kernels(coupled_kernels(elements_of([*body.blocks, *model.blocks])), request.device,
                    progress=request.progress)
    first = mount[0].copy()
    first[:3, 3] = path.start
    options = request.limited(tiers.options(chosen))
    solver = CoupledSolver(body, model, friction=friction, device=request.device, options=options)
    tell = request.progress
    frames = solver.run(mount[:, None], start=first[None], keep=True,
                        progress=None if tell is None else lambda t: tell(t, len(mount), "frames"))
    turn, at = mount[:, :3, :3], mount[:, None, :3, 3]
    position = np.einsum("tji,tnj->tni", turn, np.stack([x[..., 0] for x in solver.sensor_position]) - at)
    push = np.einsum("tji,tnj->tni", turn, np.stack([f[..., 0] for f in solver.sensor_force]))
    notes = (*body.solid.notes, f"object at tier {chosen}: {len(body.mesh.tets)} tetrahedra; force and balance are the "
                                f"object's")
    # The mount holds against what holds the object.
    return Solved(scene, path, model, mount, frames, free_way(body, model, first, direction(path)), position, push,
                  np.stack(solver.pressure)[:, 0], np.stack(solver.volume)[:, 0], -frames.reaction[:, 0],
                  -frames.force, ("object",), (friction,), options.tolerance, notes, body,
                  np.stack([u[:3 * len(body.mesh.points), 0].reshape(-1, 3) for u in solver.history]), built)


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
