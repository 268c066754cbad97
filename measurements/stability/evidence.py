"""What a cell's press leaves behind for the checks: readings of every frame, and the shapes of bodies and surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measurements.stability.design import Cell
from measurements.stability.elastica import elastica
from measurements.stability.scene import bubble_scene, solid_scene
from vsfsim.core.plant import Plant
from vsfsim.core.scene import SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Capsule, ProbeShape
from vsfsim.generate.boundary import deformed_surface
from vsfsim.generate.effector import effector_of
from vsfsim.generate.effectors import bubble
from vsfsim.generate.press_result import PressResult
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.rods.model import build
from vsfsim.physics.rods.solver import RodOptions, RodSolver
from vsfsim.physics.solve.frames import Reason

STEM = 0.3  # length of the rods [m]
FLOOR = 0.05  # forces of a rod below this count as this in the balance [N]; the solver's own floor is 1 N


@dataclass(frozen=True)
class Evidence:
    """One press of T frames."""

    depth: np.ndarray
    """Way past first contact (T,) [m]."""
    push: np.ndarray
    """Force on the moving body against its direction of travel (T,) [N]."""
    force: np.ndarray
    """Force on what moves, world (T, 3) [N]."""
    balance: np.ndarray
    """Unbalanced over acting force (T,) [-]."""
    energy: np.ndarray
    """Elastic (T,) [J]; NaN where it is not known."""
    penetration: np.ndarray
    """As the solver reports it (T,) [m]."""
    converged: np.ndarray
    """(T,) bool."""
    resolved: np.ndarray
    """Whether it converged and the mesh resolves it (T,) bool."""
    reasons: tuple[str, ...]
    """Why it did not converge, one a frame; empty for a converged one."""
    seconds: np.ndarray
    """(T,) [s]."""
    straight: int
    """Number of the first frames in which the body only moves inward on a straight line."""
    conservative: bool
    """Whether the work of the push is the elastic energy: no friction, no weight, and a path that is straight."""
    edge: float
    """Mean edge of the elements [m]."""
    heavy: bool = False
    """Whether the object sinks under its weight, so that the body may not touch it yet."""
    surface: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    """Deformed surface of every frame, as fine triangles: vertices (v, 3) [m] and triangles (g, 3)."""
    membrane: Sequence[tuple[np.ndarray, np.ndarray]] = ()
    """Of a bubble on a deformable object: the membrane in every frame, likewise; `surface` is that of the object."""
    poses: np.ndarray | None = None
    """Of the rigid bodies, in the frame of the surface (T, K, 4, 4) [m]."""
    shapes: tuple[ProbeShape, ...] = ()
    """Of the rigid bodies (K)."""
    mesh: QuadraticMesh | None = None
    """Of a solid."""
    moved: np.ndarray | None = None
    """Displacements of its nodes (T, n, 3) [m]."""
    large: bool = True
    """Whether the tier knows large strains, so that det F means something."""
    jumped: np.ndarray | None = None
    """Of a rod: whether it stands behind the capsule, on the side that it cannot have reached (T,) bool."""


def gather(cell: Cell, folder: Path, limit: float, *, device: str = "cpu") -> Evidence:
    """Make the press of a cell.

    Args:
        cell: which.
        folder: an empty folder for its files.
        limit: limit of a frame's processor time [s].
        device: Warp device.

    Raises:
        VsfsimError: the press is refused.
    """
    if cell.kind == "rod":
        return _rod(cell, device)
    if cell.kind == "bubble":
        return _bubble(bubble_scene(cell, folder), limit, device)
    return _solid(cell, *solid_scene(cell, folder), limit, device)


def _solid(cell: Cell, loaded: SceneFile, tier: str, limit: float, device: str) -> Evidence:
    scene = loaded.sample(0)
    result = effector_of(scene).press(loaded, Request(tier=tier, device=device, limit=limit))
    arrays = {name: value for name, (value, _) in result.arrays.items()}
    none = np.zeros(0)  # the checks need nodes and triangles only
    mesh = QuadraticMesh(arrays["points"], arrays["tets"], none, none, arrays["faces"], none)
    free = not any(float(cell.factors.get(name, 0.0)) for name in ("friction", "gravity"))
    return _of(result, energy=result.audit["energy"], straight=len(result.depth), conservative=free,
               heavy=float(cell.factors.get("gravity", 0.0)) > 0.0,
               surface=[deformed_surface(mesh, u)[:2] for u in arrays["displacement"]], poses=arrays["poses"],
               shapes=tuple(scene.bodies), mesh=mesh, moved=arrays["displacement"],
               large=tier in ("fem-coarse", "fem", "fem-fine"))


def _bubble(loaded: SceneFile, limit: float, device: str) -> Evidence:
    request = Request(device=device, limit=limit)
    made = bubble.solve(loaded.sample(0), request)
    solved, result, surface, membrane = made.solved, bubble.result_of(made, request), [], []
    if solved.object is not None and solved.moved is not None:
        surface = [deformed_surface(solved.object.mesh, u[..., 0])[:2] for u in solved.moved]
        membrane = [(x[..., 0], solved.sensor.mesh.faces) for x in solved.position]
    return _of(result, energy=np.full(len(result.depth), np.nan), straight=solved.scene.press.frames[0],
               conservative=False, surface=surface, membrane=membrane)


def _of(result: PressResult, **more: Any) -> Evidence:
    good, held = result.converged, result.resolved
    return Evidence(result.depth, result.force[:, 2], result.force, result.audit["force_balance"],
                    penetration=result.audit["penetration"], converged=good,
                    resolved=good if held is None else good & held, reasons=result.reason,
                    seconds=result.more["seconds"], edge=float(result.more["edge"]), **more)


def _rod(cell: Cell, device: str) -> Evidence:
    f = {name: float(value) for name, value in cell.factors.items()}
    n, frames = int(f["segments"]), int(f["frames"])
    radius, size = STEM * f["slender"], STEM * f["capsule"]
    nodes = np.zeros((n + 1, 3))
    nodes[:, 2] = np.linspace(0.0, STEM, n + 1)
    one = np.ones(n + 1)
    plant = Plant(nodes, np.arange(-1, n), radius * one, 0.0 * one, np.zeros((n + 1, 3)), f["young"] * one,
                  500.0 * one, np.zeros(n + 1, int), ("stem",))
    # it begins where it touches: a path that began behind the stem would have passed it before
    travel = rod_travel(f) * np.arange(frames + 1) / frames
    poses = np.tile(np.eye(4), (frames + 1, 1, 1, 1, 1))
    poses[:, 0, 0, :3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]  # its axis lies along y
    poses[:, 0, 0, 0, 3], poses[:, 0, 0, 2, 3] = travel - radius - size, STEM * f["height"]
    out = RodSolver([build(plant)], [Capsule(size, 0.5 * STEM)], device=device, options=RodOptions()).run(
        np.zeros(1, int), poses, friction=f["friction"], keep_nodes=True)
    assert out.nodes is not None
    line, centre = out.nodes[1:, 0], poses[1:, 0, 0, :3, 3]
    force, reaction = out.force[1:, 0], out.reaction[1:, 0]
    return Evidence(
        travel[1:], -force[:, 0, 0], force[:, 0],
        np.linalg.norm(reaction - force.sum(axis=1), axis=1) / np.maximum(np.linalg.norm(reaction, axis=1), FLOOR),
        out.energy[1:, 0], out.penetration[1:, 0], out.converged[1:, 0], out.converged[1:, 0],
        tuple(Reason(r).text for r in out.reason[1:, 0]), np.zeros(frames), frames, f["friction"] == 0.0, STEM / n,
        jumped=np.array([_behind(x, c, size, radius) for x, c in zip(line, centre, strict=True)]))


def rod_travel(factors: Mapping[str, float]) -> float:
    """Way of the capsule past first contact [m]. A capsule that reaches below the clamp meets the clamped end after r -
    sqrt(r^2 - h^2), where r is the distance of the axes in contact and h the capsule's height: past that there is no
    equilibrium, and it stops at nine tenths of that way."""
    wanted, high = STEM * factors["depth"], STEM * factors["height"]
    apart = STEM * (factors["slender"] + factors["capsule"])
    return wanted if apart <= high else min(wanted, 0.9 * (apart - (apart**2 - high**2) ** 0.5))


def _behind(line: np.ndarray, centre: np.ndarray, size: float, radius: float) -> bool:
    """Whether a stem (n, 3) passes a capsule at ``centre`` (3,) on the side that the capsule came from, although an
    exact stem would still lean on it. Past that it may have slipped off over its end, or sideways."""
    way, _ = elastica(float(centre[2]), size + radius, STEM)
    if not len(way) or centre[0] > way[-1] - 0.01 * STEM:
        return False
    x, z = line[:, 0], line[:, 2]
    crossing = np.flatnonzero((z[:-1] < centre[2]) & (z[1:] >= centre[2]))
    if not len(crossing):
        return False
    k = int(crossing[0])
    share = (centre[2] - z[k]) / (z[k + 1] - z[k])
    return bool(x[k] + share * (x[k + 1] - x[k]) < centre[0] - 0.5 * size)
