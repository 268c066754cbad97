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
from vsfsim.generate.touch import audit, clearance
from vsfsim.physics import sdf, tiers
from vsfsim.physics.device import compile_kernels, solver_kernels
from vsfsim.physics.model import Model
from vsfsim.physics.solver import Solver
from vsfsim.robot.press import press_path, turn_to


@dataclass(frozen=True)
class PressResult:
    """What `vsfsim press` prints.

    depth: way of the probe from the start of contact along the press (T,) [m]; 0 before contact.
    force: on the probe (T, 3) [N]. reaction: of the supports on the body (T, 3) [N]. pressure: (T,) [Pa] or None without gas.
    converged: (T,) bool. residual: (T,) [-]. iterations: Newton (T,). seconds: of each frame (T,) [s].
    audit: force_balance [-], min_det_f [-], energy [J], penetration [m], each (T,).
    build_seconds: meshing and factorisation [s]. tets, nodes, tier, device, precision: of the model.
    element_size: edge length aimed at [m]. notes: what was repaired or decided.
    """

    depth: np.ndarray
    force: np.ndarray
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
    notes: tuple[str, ...]

    def table(self) -> dict[str, Any]:
        """The result as plain lists and numbers, for JSON."""
        out: dict[str, Any] = {}
        for key, value in vars(self).items():
            if isinstance(value, np.ndarray):
                out[key] = value.tolist()
            elif isinstance(value, dict):
                out[key] = {k: v.tolist() for k, v in value.items()}
            else:
                out[key] = list(value) if isinstance(value, tuple) else value
        return out


def first_contact(model: Model, poses: np.ndarray, probe: Any) -> float:
    """How far along the straight path (T, 4, 4) the probe's surface first meets the body at rest [m], from its first pose."""
    axis = poses[-1, :3, 3] - poses[0, :3, 3]
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        return 0.0
    return clearance(model, probe, poses[0], axis / length)


def press(scene: Scene, *, tier: str | None = None, device: str = "cpu", precision: str = "float64",
          seed: int = 0, cache: Path | None = None, progress: Callable[[int, int, str], None] | None = None) -> PressResult:
    """Run the ``[press]`` of a scene.

    Args:
        scene: concrete. tier: overrides the scene's. device: Warp device. precision: "float32" or "float64".
        seed: of what a family draws. cache: folder of filled meshes. progress: called with (done, in all, what).

    Raises:
        SceneError: the scene has no ``[press]``, or cannot be built.
    """
    if scene.press is None:
        raise SceneError(f"{scene.source}: there is no [press]; add e.g. from = [0, 0, 0.07], to = [0, 0, 0.065], frames = 10.")
    chosen = tiers.choose(scene, tier)
    began = time.perf_counter()
    poses = press_path(scene.press, scene.probe)
    start = np.array(scene.press.start)
    stop = np.array(scene.press.stop)
    axis = (stop - start) / np.linalg.norm(stop - start)
    model = tiers.build(scene, chosen, seed=seed, cache=cache, focus=tip(scene, stop, axis)[None])
    built = time.perf_counter() - began
    first = poses[0].copy()
    first[:3, 3] = start
    inside = overlap(model, scene.probe, first, str(scene.source))
    compile_kernels(solver_kernels(precision, [block.kind for block in model.blocks]), device, progress=progress)
    gap = first_contact(model, np.stack([first, poses[scene.press.frames - 1]]), scene.probe)
    solver = Solver(model, scene.probe, device=device, precision=precision, options=tiers.options(chosen),
                    linear=not tiers.TIERS[chosen].nonlinear)
    frames = solver.run(poses[:, None], progress=None if progress is None else lambda done: progress(done, len(poses), "frames"))
    way = (poses[:, :3, 3] - start) @ axis
    depth = np.maximum(way - gap, 0.0)
    return PressResult(
        depth=depth, force=frames.force[:, 0], reaction=frames.reaction[:, 0], pressure=None,
        converged=frames.converged[:, 0], residual=frames.residual[:, 0], iterations=frames.iterations[:, 0],
        seconds=frames.seconds, audit=audit(frames, 0), build_seconds=built, tets=len(model.mesh.tets),
        nodes=len(model.mesh.points), tier=chosen, device=device, precision=precision,
        element_size=tiers.element_size(scene.object, chosen, scene.probe), notes=(*model.solid.notes, *path_notes(gap, float(way.max()), inside)))


def overlap(model: Model, probe: Any, pose: np.ndarray, where: str) -> float:
    """How deep the body's surface at rest lies inside a probe at ``pose`` (4, 4) [m]; 0 if they are apart.

    Raises:
        SceneError: the whole probe is inside the body. ``where`` is the scene file.
    """
    centre = pose[:3, 3]
    corners = model.mesh.points[model.mesh.tets[:, :4]]
    weights = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), (centre - corners[:, 0])[..., None])[..., 0]
    inside = (weights >= 0.0).all(axis=1) & (weights.sum(axis=1) <= 1.0)
    points = (model.mesh.points[np.unique(model.mesh.faces)] - pose[:3, 3]) @ pose[:3, :3]
    nearest = float(sdf.distance(probe, points).min())
    if inside.any() and nearest > 0.0:
        raise SceneError(f"{where} [press]: from = {[round(v, 6) for v in centre.tolist()]} puts the whole probe inside the body, where it touches nothing; "
                         "start outside (world coordinates of the probe's centre, in metres).")
    return max(0.0, -nearest)


def path_notes(gap: float, way: float, inside: float) -> list[str]:
    """What a user should know about the path: it misses the body, or starts in it.

    Args:
        gap: to first contact from the start [m]. way: how far the probe goes [m]. inside: overlap at the start [m].
    """
    if gap >= way:
        there = "meets nothing on its line" if not np.isfinite(gap) else f"would meet it after {1e3 * gap:.1f} mm, and goes {1e3 * way:.1f} mm"
        return [f"The probe never touches the body: it {there}. Check from and to in [press], world coordinates in metres of the probe's centre."]
    if inside > 0.05 * way:  # less is the faceting of a round body
        return [f"The probe starts {1e3 * inside:.1f} mm inside the body, so depth counts from there and not from first contact; "
                "move from in [press] back to where the probe is free."]
    return []


def tip(scene: Scene, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The leading point of the probe (3,) [m] when its centre is at ``centre``, moving along ``axis``."""
    return centre + sdf.support(scene.probe, turn_to(axis, scene.probe).T @ axis) * axis


def text(result: PressResult) -> str:
    """The result as a table for people."""
    rows = ["  depth mm    force N      fx       fy       fz   balance  min det F  iterations     s"]
    for t in range(len(result.depth)):
        f = result.force[t]
        mark = "" if result.converged[t] else f"  NOT CONVERGED (residual {result.residual[t]:.1e})"
        rows.append(f"{1e3 * result.depth[t]:10.3f} {np.linalg.norm(f):10.4f} {f[0]:8.4f} {f[1]:8.4f} {f[2]:8.4f}  {result.audit['force_balance'][t]:8.1e}"
                    f" {result.audit['min_det_f'][t]:10.3f} {result.iterations[t]:11d} {result.seconds[t]:5.2f}{mark}")
    good = int(result.converged.sum())
    rows.append(f"{good} of {len(result.depth)} frames converged; tier {result.tier}, {result.tets} quadratic tetrahedra, {result.nodes} nodes, element size "
                f"{1e3 * result.element_size:.1f} mm, {result.precision} on {result.device}; built in {result.build_seconds:.1f} s")
    rows.extend(f"note: {sentence}" for sentence in result.notes)
    return "\n".join(rows)
