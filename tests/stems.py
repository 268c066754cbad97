"""Small plants for tests."""

from __future__ import annotations

import numpy as np

from vsfsim.core.plant import Plant
from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.model import RodModel, build
from vsfsim.physics.rods.solver import RodFrames, RodOptions, RodSolver


def plant(nodes: np.ndarray, parent: list[int] | np.ndarray, *, radius: np.ndarray | float = 0.003,
          young_modulus: np.ndarray | float = 1e9, half_width: np.ndarray | float = 0.0,
          blade_normal: np.ndarray | None = None) -> Plant:
    """A plant of one region; scalars hold for every segment."""
    n = len(nodes)
    fill = {name: np.broadcast_to(np.asarray(value, float), (n,)).copy() for name,
            value in (("radius", radius), ("young_modulus", young_modulus), ("half_width", half_width))}
    normal = np.zeros((n, 3)) if blade_normal is None else np.broadcast_to(blade_normal, (n, 3)).copy()
    return Plant(np.asarray(nodes, float), np.asarray(parent), density=np.full(n, 500.0),
                 region=np.zeros(n, int), region_names=("stem",), blade_normal=normal, **fill)


def stem(segments: int, *, length: float = 0.4, **section: object) -> Plant:
    """A straight upright stem from the origin."""
    nodes = np.zeros((segments + 1, 3))
    nodes[:, 2] = np.linspace(0.0, length, segments + 1)
    return plant(nodes, np.arange(-1, segments), **section)  # type: ignore[arg-type]


def crossing(travel: np.ndarray, *, height: float, start: float, along: str = "x") -> np.ndarray:
    """Poses (T, 1, 1, 4, 4) of a level capsule that crosses the x-z plane, moved along x, or along z past x =
    ``start``."""
    out = np.tile(np.eye(4), (len(travel), 1, 1, 1, 1))
    out[:, 0, 0, :3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    out[:, 0, 0, 0, 3], out[:, 0, 0, 2, 3] = start, height
    out[:, 0, 0, 0 if along == "x" else 2, 3] += travel
    return out


def touch(model: RodModel | Plant, poses: np.ndarray, *, radius: float = 0.03, length: float = 0.2,
          friction: float = 0.0, device: str = "cpu", **options: float) -> RodFrames:
    """One touch by capsules of one size, nodes kept."""
    model = build(model) if isinstance(model, Plant) else model
    solver = RodSolver([model], [Capsule(radius, length)] * poses.shape[2], device=device,
                       options=RodOptions(**options))  # type: ignore[arg-type]
    return solver.run(np.zeros(poses.shape[1], int), poses, friction=friction, keep_nodes=True)


def loaded(body: Plant, forces: dict[int, tuple[float, float, float]], *, device: str = "cpu",
           tolerance: float = 1e-9) -> RodFrames:
    """The plant under dead forces [N] at nodes, with a capsule far away."""
    model = build(body)
    for node, force in forces.items():
        model.arrays["load"][node] = force
    far = np.eye(4)[None, None, None].copy()
    far[..., 0, 3] = 5.0
    return touch(model, far, device=device, tolerance=tolerance, force_floor=1e-30)
