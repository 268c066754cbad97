"""A press of an air-filled bubble on a deformable object or on rigid bodies: path of its mount in, force and pressure
against depth out.

The bubble moves along ``[press]`` in the probe's place: its mount's origin follows the path, its +z leads. Against
rigid bodies the solver works in the mount frame, where the obstacles move; with an object both find one equilibrium
(`CoupledSolver`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.rotation import rotation_matrix
from vsfsim.core.scene import Scene
from vsfsim.core.shape import Plane
from vsfsim.generate.aim import clearance
from vsfsim.generate.record import audit
from vsfsim.generate.table import plain
from vsfsim.physics import tiers
from vsfsim.physics.bubble import sensor as bubble
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.mesh.membrane_refine import wishes
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.coupled import CoupledSolver, free_way
from vsfsim.physics.solve.frames import Frames, SolverOptions
from vsfsim.physics.solve.kernels import coupled_kernels, solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import press_path
from vsfsim.sensing.bubble import readout_of

# as the fem tier: with friction, tighter balances are not always reached where a point hovers between touching and
# leaving
OPTIONS = SolverOptions(tolerance=5e-4)


@dataclass(frozen=True)
class BubbleState:
    """The sensor in every frame, in its mount frame.

    model: the bubble. mount: its pose in the world (T, 4, 4) [m]. node_position: of the fine mesh (T, n, 3) [m].
    node_force: contact force on every node of it (T, n, 3) [N]. object: the deformable body that it presses, or None.
    object_displacement: of that body's nodes, in the world (T, N, 3) [m], or None.
    """

    model: bubble.BubbleModel
    mount: np.ndarray
    node_position: np.ndarray
    node_force: np.ndarray
    object: Model | None = None
    object_displacement: np.ndarray | None = None

    def read_out_position(self) -> np.ndarray:
        """Nodes of the read-out mesh (T, 390, 3) [m]."""
        return self.model.read_out.positions(self.node_position)

    def read_out_force(self) -> np.ndarray:
        """The contact forces handed to the nodes of the read-out mesh (T, 390, 3) [N]: with the same net force and
        moment."""
        return readout_of(self.model).forces(self.node_position, self.node_force)


@dataclass(frozen=True)
class BubblePress:
    """What `vsfsim press` prints of a sensor.

    depth: way of the mount past first contact, along the first part of its path (T,) [m]; 0 before. force: on the
    sensor, in the world (T, 3) [N].
    body_force: on each obstacle, in the world (T, K, 3) [N]. bodies: their names (K,). friction: Coulomb coefficient of
    each (K,) [-].
    wrench: of the contact at the mount's origin, in the mount frame: force [N] and moment [N m] (T, 6).
    reaction: of the mount on the sensor, in the world (T, 3) [N]. pressure: gauge (T,) [Pa]. pressure_change: since the
    free dome (T,) [Pa].
    volume: of all the gas (T,) [m^3]. converged: (T,) bool. residual: (T,) [-]. iterations: Newton (T,). cg_iterations:
    conjugate gradients (T,).
    slipping: share of the points in contact that slip (T,) [-]. seconds: of each frame (T,) [s]. audit: force_balance
    [-], min_det_f [-], energy [J], penetration [m], each (T,).
    apex: height of the free dome over the rim [m]. dome_volume: under the free dome [m^3]. edge: mean edge of the mesh
    where it is touched [m].
    build_seconds: inflation, or reading it, and factor [s]. triangles, nodes, device, precision: of the model.
    tolerance: of the residual [-]. inward: number of frames before hold and retract. notes: what a user should know.
    statement: of convergence, in words. state: of every frame, if asked for; not part of `table`.
    """

    depth: np.ndarray
    force: np.ndarray
    body_force: np.ndarray
    bodies: tuple[str, ...]
    friction: tuple[float, ...]
    wrench: np.ndarray
    reaction: np.ndarray
    pressure: np.ndarray
    pressure_change: np.ndarray
    volume: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    cg_iterations: np.ndarray
    slipping: np.ndarray
    seconds: np.ndarray
    audit: dict[str, np.ndarray]
    apex: float
    dome_volume: float
    edge: float
    build_seconds: float
    triangles: int
    nodes: int
    device: str
    precision: str
    tolerance: float
    inward: int
    notes: tuple[str, ...]
    statement: str
    state: BubbleState | None = None

    def table(self) -> dict[str, Any]:
        """The result as plain lists and numbers, for JSON."""
        return plain(self)


@dataclass(frozen=True)
class _Run:
    """What a solver gave.

    gap: way of the mount to first contact [m]. node: positions of the membrane's nodes in the mount frame (T, n, 3)
    [m]; push: contact forces on them (T, n, 3) [N].
    pressure: gauge (T,) [Pa]. inside: volume under the membrane (T,) [m^3]. reaction: of the mount on the sensor, in
    the world (T, 3) [N].
    body_force: on each body (T, K, 3) [N]. friction: Coulomb coefficient of each (K,) [-]. tolerance: of the residual
    [-]. object, moved: the deformable body and the displacements of its nodes (T, N, 3) [m], if there is one.
    """

    frames: Frames
    gap: float
    node: np.ndarray
    push: np.ndarray
    pressure: np.ndarray
    inside: np.ndarray
    reaction: np.ndarray
    body_force: np.ndarray
    bodies: tuple[str, ...]
    friction: tuple[float, ...]
    tolerance: float
    notes: tuple[str, ...] = ()
    object: Model | None = None
    moved: np.ndarray | None = None


def press(scene: Scene, *, tier: str | None = None, seed: int = 0, device: str = "cpu", precision: str = "float64",
          cache: Path | None = None, keep: bool = False,
          progress: Callable[[int, int, str], None] | None = None) -> BubblePress:
    """Run the ``[press]`` of a scene with a ``[sensor]`` and an object, or obstacles.

    Args:
        scene: concrete. tier: of the object, overrides the scene's. seed: of what a family draws. device: Warp device.
        precision: "float64".
        cache: folder of inflated shapes and meshes. keep: also keep every frame's state. progress: called with (done,
        in all, what).

    Raises:
        SceneError: there is no path, both an object and obstacles, a tier that a sensor cannot press, or something
        cannot be built.
    """
    from vsfsim.press.probe import path_notes
    from vsfsim.press.text import statement

    assert scene.sensor is not None
    spec = scene.press
    if spec is None:
        raise SceneError(f"{scene.source}: a scene with a [sensor] needs a [press]: the path of the middle of its rim, "
                         f"e.g. from = [0, 0, 0.05], to = [0, 0, 0.02].")
    if scene.object is not None and scene.obstacles:
        raise SceneError(f"{scene.source}: a [sensor] presses an [object] or [[obstacles]]; this scene has both. Take "
                         f"one of them out.")
    if scene.object is None and tier is not None:
        raise SceneError(f"--tier {tier}: this scene has a [sensor] and no [object], and tiers are of objects; the "
                         f"sensor's mesh is set by nodes in [sensor]. Leave --tier out.")
    if precision != "float64":
        raise SceneError(f"--precision {precision}: a [sensor] needs float64. At rest its membrane balances some 50 N "
                         f"of gas pressure node by node, and single precision "
                         "leaves more of it unbalanced than a light touch pushes.")
    began = time.perf_counter()
    model = bubble.build_bubble(scene.sensor, where=f"{scene.source} [sensor]", cache=cache)
    mount = press_path(spec, Plane())  # a plane's +z leads, as a sensor's does
    poses = in_mount(scene, mount)
    said: tuple[str, ...] = ()
    if scene.object is None:
        finer = wishes(model.mesh.points, model.element_size, RigidBodies(scene.bodies), poses,
                       scene.sensor.contact_edge)
        if finer:
            model = bubble.build_bubble(scene.sensor, finer=finer, where=f"{scene.source} [sensor]", cache=cache)
            said = (f"{scene.sensor.nodes} nodes became {len(model.mesh.points)}: triangles are smaller where bodies "
                    f"touch; contact_edge in [sensor] says how small.",)
    built = time.perf_counter() - began
    axis, start = _first_way(scene)
    if scene.object is None:
        run = _on_obstacles(scene, model, mount, poses, axis, start, device, precision, progress)
    else:
        run = _on_object(scene, model, mount, axis, start, device, precision, tier, seed, cache, progress)
    frames = run.frames
    turn = mount[:, :3, :3]
    wrench = np.concatenate([run.push.sum(axis=1), np.cross(run.node, run.push).sum(axis=1)], axis=1)
    way = (mount[:, :3, 3] - start) @ axis
    return BubblePress(
        depth=np.maximum(way - run.gap, 0.0), force=np.einsum("tij,tj->ti", turn, wrench[:, :3]),
                       body_force=run.body_force, bodies=run.bodies, friction=run.friction,
        wrench=wrench, reaction=run.reaction,
        pressure=run.pressure, pressure_change=run.pressure - model.pressure, volume=run.inside + model.dead_volume,
        converged=frames.converged[:, 0], residual=frames.residual[:, 0], iterations=frames.iterations[:, 0],
                       cg_iterations=frames.cg_iterations[:, 0],
        slipping=frames.slipping[:, 0], seconds=frames.seconds, audit=audit(frames, 0),
                       apex=float(model.mesh.points[:, 2].max()),
        dome_volume=float(model.mesh.volume[0]), edge=model.element_size, build_seconds=built,
                       triangles=len(model.mesh.faces), nodes=len(model.mesh.points),
        device=device, precision=precision, tolerance=run.tolerance, inward=spec.inward,
                       notes=(*path_notes(run.gap, float(way.max()), 0.0), *said, *run.notes),
        statement=_statement(frames, statement(frames, 0, edge=model.element_size, tolerance=run.tolerance,
                                               linear=False)),
        state=BubbleState(model, mount, run.node, run.push, run.object, run.moved) if keep else None)


def _on_obstacles(scene: Scene, model: bubble.BubbleModel, mount: np.ndarray, poses: np.ndarray, axis: np.ndarray,
                  start: np.ndarray, device: str, precision: str,
                  progress: Callable[[int, int, str], None] | None) -> _Run:
    compile_kernels(solver_kernels(precision, [block.kind for block in model.blocks]), device, progress=progress)
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = mount[0, :3, :3], start
    gap = min(clearance(model, shape, pose, -first[:3, :3].T @ axis) for shape,
              pose in zip(scene.bodies, in_mount(scene, first[None])[0], strict=True))
    solver = Solver(model, scene.bodies, friction=scene.frictions, device=device, precision=precision, options=OPTIONS)
    pressure: list[float] = []
    inside: list[float] = []

    def done(frames: int) -> None:
        pressure.append(float(solver.elasticity.pressure.numpy()[0]))
        inside.append(float(solver.elasticity.volume.numpy()[0]))
        if progress is not None:
            progress(frames, len(poses), "frames")

    frames = solver.run(poses[:, None], keep=True, progress=done)

    def world(force: np.ndarray) -> np.ndarray:
        return np.einsum("tij,t...j->t...i", mount[:, :3, :3], force)

    return _Run(frames, gap, model.mesh.points + np.stack([u[:, 0].reshape(-1, 3) for u in solver.history]),
                np.stack([f[..., 0] for f in solver.surface_force]),
                np.array(pressure), np.array(inside), world(frames.reaction[:, 0]), world(frames.body_force[:, 0]),
                tuple(f"obstacle {i + 1}" for i in range(len(scene.obstacles))), scene.frictions, OPTIONS.tolerance)


def _on_object(scene: Scene, model: bubble.BubbleModel, mount: np.ndarray, axis: np.ndarray, start: np.ndarray,
               device: str, precision: str, tier: str | None,
               seed: int, cache: Path | None, progress: Callable[[int, int, str], None] | None) -> _Run:
    assert scene.sensor is not None
    chosen = tiers.choose(scene, tier)
    if not tiers.TIERS[chosen].nonlinear or chosen == "spring":
        if tier is not None or scene.object.tier != "auto":
            raise SceneError(f"{scene.source}: tier {chosen!r} cannot be pressed by a [sensor], which bends far; tier "
                             f"= \"fem-coarse\" or finer would do.")
        chosen = "fem-coarse"
    body = tiers.build(scene, chosen, seed=seed, cache=cache)
    compile_kernels(coupled_kernels(precision, [block.kind for block in (*body.blocks, *model.blocks)]), device,
                    progress=progress)
    first = mount[0].copy()
    first[:3, 3] = start
    options = tiers.options(chosen)
    solver = CoupledSolver(body, model, friction=scene.sensor.friction, device=device, precision=precision,
                           options=options)
    frames = solver.run(mount[:, None], keep=True, progress=None if progress is None
                        else lambda t: progress(t, len(mount), "frames"))
    turn, at = mount[:, :3, :3], mount[:, None, :3, 3]
    node = np.einsum("tji,tnj->tni", turn, np.stack([x[..., 0] for x in solver.sensor_position]) - at)
    push = np.einsum("tji,tnj->tni", turn, np.stack([f[..., 0] for f in solver.sensor_force]))
    return _Run(frames, free_way(body, model, first, axis), node, push, np.stack(solver.pressure)[:, 0],
                np.stack(solver.volume)[:, 0],
                -frames.reaction[:, 0],  # of what holds the object: the mount holds against it
                -frames.force, ("object",), (scene.sensor.friction,), options.tolerance,
                notes=(*body.solid.notes,
                       f"object at tier {chosen}: {len(body.mesh.tets)} tetrahedra; force and balance are "
                       f"the object's"), object=body,
                moved=np.stack([u[:3 * len(body.mesh.points), 0].reshape(-1, 3) for u in solver.history]))


def _statement(frames: Frames, words: str) -> str:
    """Without det F, which an incompressible membrane has not."""
    return words[:words.rindex(" smallest det F")].rstrip(";") + "."


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


def _first_way(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction (3,) of the first part of the path, and where it begins (3,) [m]."""
    from vsfsim.press.probe import direction

    assert scene.press is not None
    return direction(scene), np.array(scene.press.start)


def way_in(scene: Scene) -> np.ndarray:
    """The way of standing bodies into the dome along the first part of the path, in the mount frame (3,)."""
    assert scene.press is not None
    return -press_path(scene.press, Plane())[0, :3, :3].T @ _first_way(scene)[0]


def text(result: BubblePress) -> str:
    """The result as a table for people."""
    rows = ["  depth mm    force N      fx       fy       fz   pressure Pa   change Pa  volume mL   balance  penetr. % "
            " residual  iterations     s"]
    for t in range(len(result.depth)):
        f = result.force[t]
        mark = "" if result.converged[t] else "  NOT CONVERGED"
        rows.append(f"{1e3 * result.depth[t]:10.3f} {np.linalg.norm(f):10.4f} {f[0]:8.4f} {f[1]:8.4f} {f[2]:8.4f} "
                    f"{result.pressure[t]:13.2f} {result.pressure_change[t]:11.2f}"
                    f" {1e6 * result.volume[t]:10.4f}  {result.audit['force_balance'][t]:8.1e} "
                    f"{100 * result.audit['penetration'][t] / result.edge:10.2g}"
                    f"  {result.residual[t]:8.1e} {result.iterations[t]:11d} {result.seconds[t]:5.2f}{mark}")
    w = result.wrench[result.inward - 1]
    rows.append(f"At full depth, wrench of the contact at the mount, in its frame: "
                f"({', '.join(f'{v + 0.0:.4f}' for v in w[:3])}) N, "
                f"({', '.join(f'{v + 0.0:.5f}' for v in w[3:])}) N m; {100 * result.slipping[result.inward - 1]:.0f} % "
                f"of the points in contact slip.")
    rows.append(result.statement)
    rows.append(f"Free dome: apex {1e3 * result.apex:.2f} mm, {1e6 * result.dome_volume:.2f} mL, "
                f"{result.pressure[0] - result.pressure_change[0]:.1f} Pa gauge. "
                f"{result.triangles} triangles, {result.nodes} nodes, mean edge where it is touched "
                f"{1e3 * result.edge:.2f} mm, "
                f"{result.precision} on {result.device}; built in {result.build_seconds:.1f} s, solved in "
                f"{result.seconds.sum():.1f} s.")
    rows.extend(f"note: {sentence}" for sentence in result.notes)
    return "\n".join(rows)
