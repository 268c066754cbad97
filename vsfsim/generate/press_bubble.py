"""A press of an air-filled bubble on rigid bodies: path of its mount in, force and pressure against depth out.

The bubble moves along ``[press]`` in the probe's place: its mount's origin follows the path, its +z leads. The solver works in the mount frame,
where the obstacles move.
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
from vsfsim.generate.touch import audit, clearance
from vsfsim.physics import bubble
from vsfsim.physics.device import compile_kernels, solver_kernels
from vsfsim.physics.frames import Frames, SolverOptions
from vsfsim.physics.solver import Solver
from vsfsim.robot.press import press_path

OPTIONS = SolverOptions(tolerance=5e-4)  # as the fem tier: with friction, tighter balances are not always reached where a point hovers between touching and leaving


@dataclass(frozen=True)
class BubbleState:
    """The sensor in every frame, in its mount frame.

    model: the bubble. mount: its pose in the world (T, 4, 4) [m]. node_position: of the fine mesh (T, n, 3) [m].
    node_force: contact force on every node of it (T, n, 3) [N].
    """

    model: bubble.BubbleModel
    mount: np.ndarray
    node_position: np.ndarray
    node_force: np.ndarray

    def read_out_position(self) -> np.ndarray:
        """Nodes of the read-out mesh (T, 390, 3) [m]."""
        return self.model.read_out.positions(self.node_position)

    def read_out_force(self) -> np.ndarray:
        """The contact forces handed to the nodes of the read-out mesh (T, 390, 3) [N]: each to the corners of its triangle, with the same sum."""
        seen = self.model.read_out
        share = bubble.locate(seen.flat, seen.faces, self.model.flat).T
        return np.stack([share @ force for force in self.node_force])


@dataclass(frozen=True)
class BubblePress:
    """What `vsfsim press` prints of a sensor.

    depth: way of the mount past first contact, along the first part of its path (T,) [m]; 0 before. force: on the sensor, in the world (T, 3) [N].
    body_force: on each obstacle, in the world (T, K, 3) [N]. bodies: their names (K,). friction: Coulomb coefficient of each (K,) [-].
    wrench: of the contact at the mount's origin, in the mount frame: force [N] and moment [N m] (T, 6).
    reaction: of the mount on the sensor, in the world (T, 3) [N]. pressure: gauge (T,) [Pa]. pressure_change: since the free dome (T,) [Pa].
    volume: of all the gas (T,) [m^3]. converged: (T,) bool. residual: (T,) [-]. iterations: Newton (T,). cg_iterations: conjugate gradients (T,).
    slipping: share of the points in contact that slip (T,) [-]. seconds: of each frame (T,) [s]. audit: force_balance [-], min_det_f [-], energy [J], penetration [m], each (T,).
    apex: height of the free dome over the rim [m]. dome_volume: under the free dome [m^3]. edge: mean edge of the mesh [m].
    build_seconds: inflation, or reading it, and factor [s]. triangles, nodes, device, precision: of the model. tolerance: of the residual [-]. inward: number of frames before
    hold and retract. notes: what a user should know. statement: of convergence, in words. state: of every frame, if asked for; not part of `table`.
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
        out: dict[str, Any] = {}
        for key, value in vars(self).items():
            if key == "state":
                continue
            if isinstance(value, np.ndarray):
                out[key] = value.tolist()
            elif isinstance(value, dict):
                out[key] = {k: v.tolist() for k, v in value.items()}
            else:
                out[key] = list(value) if isinstance(value, tuple) else value
        return out


def press(scene: Scene, *, device: str = "cpu", precision: str = "float64", cache: Path | None = None, keep: bool = False,
          progress: Callable[[int, int, str], None] | None = None) -> BubblePress:
    """Run the ``[press]`` of a scene with a ``[sensor]`` and obstacles.

    Args:
        scene: concrete. device: Warp device. precision: "float32" or "float64". cache: folder of inflated shapes. keep: also keep every frame's state.
        progress: called with (done, in all, what).

    Raises:
        SceneError: there is no path, an object besides, or the bubble cannot be built.
    """
    from vsfsim.generate.press_text import statement

    assert scene.sensor is not None
    spec = scene.press
    if spec is None:
        raise SceneError(f"{scene.source}: a scene with a [sensor] needs a [press]: the path of the middle of its rim, e.g. from = [0, 0, 0.05], to = [0, 0, 0.02].")
    if scene.object is not None:
        raise SceneError(f"{scene.source}: a [sensor] on a deformable [object] is not part of `vsfsim press` yet; take [object] out and give [[obstacles]].")
    began = time.perf_counter()
    model = bubble.build_bubble(scene.sensor, where=f"{scene.source} [sensor]", cache=cache)
    built = time.perf_counter() - began
    compile_kernels(solver_kernels(precision, [block.kind for block in model.blocks]), device, progress=progress)
    mount = press_path(spec, Plane())  # a plane's +z leads, as a sensor's does
    poses = in_mount(scene, mount)
    axis, start = _first_way(scene)
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = mount[0, :3, :3], start
    gap = min(clearance(model, shape, pose, -first[:3, :3].T @ axis) for shape, pose in zip(scene.bodies, in_mount(scene, first[None])[0], strict=True))
    solver = Solver(model, scene.bodies, friction=scene.frictions, device=device, precision=precision, options=OPTIONS)
    pressure: list[float] = []
    inside: list[float] = []

    def done(frames: int) -> None:
        pressure.append(float(solver.elasticity.pressure.numpy()[0]))
        inside.append(float(solver.elasticity.volume.numpy()[0]))
        if progress is not None:
            progress(frames, len(poses), "frames")

    frames = solver.run(poses[:, None], keep=True, progress=done)
    turn = mount[:, :3, :3]
    push = np.stack([f[..., 0] for f in solver.surface_force])
    node = model.mesh.points + np.stack([u[:, 0].reshape(-1, 3) for u in solver.history])
    wrench = np.concatenate([push.sum(axis=1), np.cross(node, push).sum(axis=1)], axis=1)
    way = (mount[:, :3, 3] - start) @ axis

    def world(force: np.ndarray) -> np.ndarray:
        return np.einsum("tij,t...j->t...i", turn, force)

    from vsfsim.generate.press import path_notes

    return BubblePress(
        depth=np.maximum(way - gap, 0.0), force=world(wrench[:, :3]), body_force=world(frames.body_force[:, 0]),
        bodies=tuple(f"obstacle {i + 1}" for i in range(len(scene.obstacles))), friction=scene.frictions, wrench=wrench, reaction=world(frames.reaction[:, 0]),
        pressure=np.array(pressure), pressure_change=np.array(pressure) - model.pressure, volume=np.array(inside) + model.dead_volume,
        converged=frames.converged[:, 0], residual=frames.residual[:, 0], iterations=frames.iterations[:, 0], cg_iterations=frames.cg_iterations[:, 0],
        slipping=frames.slipping[:, 0], seconds=frames.seconds, audit=audit(frames, 0), apex=float(model.mesh.points[:, 2].max()),
        dome_volume=float(model.mesh.volume[0]), edge=model.element_size, build_seconds=built, triangles=len(model.mesh.faces), nodes=len(model.mesh.points),
        device=device, precision=precision, tolerance=OPTIONS.tolerance, inward=spec.inward,
        notes=tuple(path_notes(gap, float(way.max()), 0.0)), statement=_statement(frames, statement(frames, 0, edge=model.element_size, tolerance=OPTIONS.tolerance, linear=False)),
        state=BubbleState(model, mount, node, push) if keep else None)


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
    from vsfsim.generate.press import direction

    assert scene.press is not None
    return direction(scene), np.array(scene.press.start)


def text(result: BubblePress) -> str:
    """The result as a table for people."""
    rows = ["  depth mm    force N      fx       fy       fz   pressure Pa   change Pa  volume mL   balance  penetr. %  residual  iterations     s"]
    for t in range(len(result.depth)):
        f = result.force[t]
        mark = "" if result.converged[t] else "  NOT CONVERGED"
        rows.append(f"{1e3 * result.depth[t]:10.3f} {np.linalg.norm(f):10.4f} {f[0]:8.4f} {f[1]:8.4f} {f[2]:8.4f} {result.pressure[t]:13.2f} {result.pressure_change[t]:11.2f}"
                    f" {1e6 * result.volume[t]:10.4f}  {result.audit['force_balance'][t]:8.1e} {100 * result.audit['penetration'][t] / result.edge:10.2g}"
                    f"  {result.residual[t]:8.1e} {result.iterations[t]:11d} {result.seconds[t]:5.2f}{mark}")
    w = result.wrench[result.inward - 1]
    rows.append(f"At full depth, wrench of the contact at the mount, in its frame: ({', '.join(f'{v + 0.0:.4f}' for v in w[:3])}) N, "
                f"({', '.join(f'{v + 0.0:.5f}' for v in w[3:])}) N m; {100 * result.slipping[result.inward - 1]:.0f} % of the points in contact slip.")
    rows.append(result.statement)
    rows.append(f"Free dome: apex {1e3 * result.apex:.2f} mm, {1e6 * result.dome_volume:.2f} mL, {result.pressure[0] - result.pressure_change[0]:.1f} Pa gauge. "
                f"{result.triangles} triangles, {result.nodes} nodes, mean edge {1e3 * result.edge:.2f} mm, "
                f"{result.precision} on {result.device}; built in {result.build_seconds:.1f} s, solved in {result.seconds.sum():.1f} s.")
    rows.extend(f"note: {sentence}" for sentence in result.notes)
    return "\n".join(rows)
