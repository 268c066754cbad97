"""A one-off press: scene in, force against depth out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene
from vsfsim.generate.aim import clearance
from vsfsim.generate.record import audit
from vsfsim.generate.table import plain
from vsfsim.physics import tiers
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.press.assume import with_press, with_probe
from vsfsim.robot.path import body_poses, pose_at, press_path


@dataclass(frozen=True)
class PressState:
    """The deformed body in every frame.

    model: the body. bodies: the rigid shapes. poses: theirs (T, K, 4, 4), to world. displacement: of the nodes (T, n,
    3) [m].
    surface_force: contact force on the surface nodes, in the order of ``model.mesh.surface_nodes()`` (T, s, 3) [N].
    """

    model: Model
    bodies: RigidBodies
    poses: np.ndarray
    displacement: np.ndarray
    surface_force: np.ndarray


@dataclass(frozen=True)
class PressResult:
    """What `vsfsim press` prints.

    depth: way of the probe past first contact, along the first part of its path (T,) [m]; 0 before contact.
    force: on the probe and its parts together (T, 3) [N]. body_force: on each rigid body (T, K, 3) [N]. bodies: their
    names (K,).
    friction: Coulomb coefficient of each (K,) [-]. slipping: share of the points in contact that slip (T,) [-].
    reaction: of the supports on the body (T, 3) [N]. pressure: (T,) [Pa] or None without gas.
    converged: (T,) bool. residual: (T,) [-]. iterations: Newton (T,). seconds: of each frame (T,) [s].
    audit: force_balance [-], min_det_f [-], energy [J], penetration [m], each (T,).
    build_seconds: meshing and factorisation [s]. tets, nodes, tier, device, precision: of the model.
    element_size: edge length aimed at [m]. edge: mean edge of the mesh [m]. edge_at_contact: of the boundary triangles
    nearest to the probe's tip [m]. volume: of the body [m^3]. tolerance: of the residual [-].
    inward: number of frames before hold and retract. notes: what was assumed, repaired or decided. statement: of
    convergence, in words.
    state: every frame's displacements and contact forces, if asked for; not part of `table`.
    """

    depth: np.ndarray
    force: np.ndarray
    body_force: np.ndarray
    bodies: tuple[str, ...]
    friction: tuple[float, ...]
    slipping: np.ndarray
    reaction: np.ndarray
    pressure: np.ndarray | None
    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    seconds: np.ndarray
    audit: dict[str, np.ndarray]
    build_seconds: float
    tets: int
    nodes: int
    tier: str
    device: str
    precision: str
    element_size: float
    edge: float
    edge_at_contact: float
    volume: float
    tolerance: float
    inward: int
    notes: tuple[str, ...]
    statement: str
    state: PressState | None = None

    def table(self) -> dict[str, Any]:
        """The result as plain lists and numbers, for JSON."""
        return plain(self)


def press(scene: Scene, *, tier: str | None = None, device: str = "cpu", precision: str = "float64", seed: int = 0,
          cache: Path | None = None, keep: bool = False, progress: Callable[[int, int, str],
                                                                            None] | None = None) -> PressResult:
    """Run the ``[press]`` of a scene, or a default one.

    Args:
        scene: concrete. tier: overrides the scene's. device: Warp device. precision: "float32" or "float64".
        seed: of what a family draws. cache: folder of filled meshes. keep: also keep every frame's state.
        progress: called with (done, in all, what).

    Raises:
        SceneError, MeshError: the scene cannot be built.
    """
    scene, model, chosen, notes, built = prepare(scene, tier=tier, seed=seed, cache=cache)
    return run(scene, model, chosen, notes, built, device=device, precision=precision, keep=keep, progress=progress)


def prepare(scene: Scene, *, tier: str | None, seed: int,
            cache: Path | None) -> tuple[Scene, Model, str, list[str], float]:
    """The scene with its gaps filled, its model, the tier, notes, and the seconds it took."""
    began = time.perf_counter()
    chosen = tiers.choose(scene, tier)
    scene, notes = with_probe(scene)
    notes += RigidBodies(scene.bodies).notes  # a broken probe is refused before the object is meshed
    focus = None if scene.press is None else tip(scene, np.array(scene.press.stop), direction(scene))[None]
    model = tiers.build(scene, chosen, seed=seed, cache=cache, focus=focus)
    scene, more = with_press(scene, model)
    return scene, model, chosen, [*notes, *more], time.perf_counter() - began


def run(scene: Scene, model: Model, chosen: str, notes: list[str], built: float, *, device: str, precision: str,
        keep: bool,
        progress: Callable[[int, int, str], None] | None) -> PressResult:
    """Solve the frames of a prepared press; arguments as `press` and `prepare`."""
    from vsfsim.press.text import statement

    spec = scene.press
    assert spec is not None
    poses = press_path(spec, scene.probe)
    first = pose_at(spec, scene.probe, 0)
    inside = overlap(model, scene.probe, first, str(scene.source))
    compile_kernels(solver_kernels(precision, [block.kind for block in model.blocks]), device, progress=progress)
    axis = direction(scene)
    gap = min(clearance(model, shape, pose, axis) for shape, pose in zip(scene.bodies[:1 + len(scene.parts)],
                                                                         body_poses(scene, first[None])[0],
                                                                         strict=False))
    linear = not tiers.TIERS[chosen].nonlinear
    solver = Solver(model, scene.bodies, friction=scene.frictions, device=device, precision=precision,
                    options=tiers.options(chosen), linear=linear)
    every = body_poses(scene, poses)
    frames = solver.run(every[:, None], keep=keep, progress=None if progress is None
                        else lambda done: progress(done, len(poses), "frames"))
    # what the audit balances, less the obstacles' share
    force = frames.force[:, 0] - frames.body_force[:, 0, 1 + len(scene.parts):].sum(axis=1)
    way = (poses[:, :3, 3] - np.array(spec.start)) @ axis
    values: dict[str, Any] = dict(
        depth=np.maximum(way - gap, 0.0), force=force, body_force=frames.body_force[:, 0],
                                  reaction=frames.reaction[:, 0], pressure=None,
        converged=frames.converged[:, 0], residual=frames.residual[:, 0], iterations=frames.iterations[:, 0],
        slipping=frames.slipping[:, 0], bodies=names(scene), friction=scene.frictions,
        seconds=frames.seconds, audit=audit(frames, 0), build_seconds=built, tets=len(model.mesh.tets),
        nodes=len(model.mesh.points), tier=chosen, device=device, precision=precision,
        element_size=tiers.element_size(scene.object, chosen, scene.probe), edge=model.element_size,
        edge_at_contact=edge_at(model, tip(scene, np.array(spec.stop), axis)), volume=float(model.mesh.volume.sum()),
        tolerance=tiers.options(chosen).tolerance, inward=spec.inward,
        notes=(*notes, *model.solid.notes, *path_notes(gap, float(way.max()), inside)))
    state = None
    if keep:
        displacement = np.stack([u[:, 0].reshape(-1, 3) for u in solver.history])
        state = PressState(model, solver.bodies, every, displacement,
                           np.stack([force[..., 0] for force in solver.surface_force]))
    return PressResult(**values, statement=statement(frames, 0, edge=model.element_size, tolerance=values["tolerance"],
                                                     linear=linear), state=state)


def names(scene: Scene) -> tuple[str, ...]:
    """What the K rigid bodies of a scene are called in tables."""
    return ("probe", *(f"part {i + 1}" for i in range(len(scene.parts))),
            *(f"obstacle {i + 1}" for i in range(len(scene.obstacles))))


def edge_at(model: Model, point: np.ndarray) -> float:
    """Mean edge [m] of the two dozen boundary triangles nearest to ``point`` (3,) [m], of the body at rest."""
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    near = np.argsort(np.linalg.norm(corners.mean(axis=1) - point, axis=1))[:24]
    return float(np.linalg.norm(corners[near] - np.roll(corners[near], 1, axis=1), axis=2).mean())


def direction(scene: Scene) -> np.ndarray:
    """Unit direction (3,) of the first part of the path that goes anywhere; down for a turn on the spot."""
    assert scene.press is not None
    for a, b in zip(scene.press.path[:-1], scene.press.path[1:], strict=True):
        if a != b:
            way = np.array(b) - np.array(a)
            return way / np.linalg.norm(way)
    return np.array([0.0, 0.0, -1.0])


def overlap(model: Model, probe: Any, pose: np.ndarray, where: str) -> float:
    """How deep the body's surface at rest lies inside a probe at ``pose`` (4, 4) [m]; 0 if they are apart.

    Raises:
        SceneError: the whole probe is inside the body. ``where`` is the scene file.
    """
    centre = pose[:3, 3]
    corners = model.mesh.points[model.mesh.tets[:, :4]]
    weights = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2),
                              (centre - corners[:, 0])[..., None])[..., 0]
    inside = (weights >= 0.0).all(axis=1) & (weights.sum(axis=1) <= 1.0)
    points = (model.mesh.points[np.unique(model.mesh.faces)] - pose[:3, 3]) @ pose[:3, :3]
    nearest = float(sdf.distance(probe, points).min())
    if inside.any() and nearest > 0.0:
        raise SceneError(f"{where} [press]: from = {[round(v, 6) for v in centre.tolist()]} puts the whole probe "
                         f"inside the body, where it touches nothing; "
                         "start outside (world coordinates of the probe's centre, in metres).")
    return max(0.0, -nearest)


def path_notes(gap: float, way: float, inside: float) -> list[str]:
    """What a user should know about the path: it misses the body, or starts in it.

    Args:
        gap: to first contact from the start [m]. way: how far the probe goes [m]. inside: overlap at the start [m].
    """
    if gap >= way:
        there = ("meets nothing on its line" if not np.isfinite(gap)
                 else f"would meet it after {1e3 * gap:.1f} mm, and goes {1e3 * way:.1f} mm")
        return [f"The probe never touches the body: it {there}. Check from and to in [press], world coordinates in "
                f"metres of the probe's centre."]
    if inside > 0.05 * way:  # less is the faceting of a round body
        return [f"The probe starts {1e3 * inside:.1f} mm inside the body, so depth counts from there and not from "
                f"first contact; "
                "move from in [press] back to where the probe is free."]
    return []


def tip(scene: Scene, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The leading point of the probe (3,) [m] when its centre is at ``centre``, moving along ``axis``."""
    assert scene.press is not None
    turn = pose_at(scene.press, scene.probe, scene.press.inward)[:3, :3]
    return centre + sdf.support(scene.probe, turn.T @ axis) * axis
