"""Error of the force against depth: `vsfsim measure shallow`.

The ball of S1 is pressed at six places within an element, on meshes made without knowing where, as those of a dataset
are, and on the mesh of a press. The reference is `references/s1.json`.
"""

from __future__ import annotations

import dataclasses
import time

import numpy as np

import references
from measurements import resolution as random_balls
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

PLACES = np.array([(0.0, 0.0), (0.5, 0.0), (0.25, 0.25), (0.5, 0.5), (0.2, 0.4), (0.35, 0.1)])
"""Places of the ball's axis from a corner of an element (6, 2), over the element's edge [-]."""
DEPTHS = (0.0005, 0.001, 0.0025, 0.005)
"""Depths of the ball [m]."""
MESHES: tuple[tuple[str, float | None], ...] = (("fem", None), ("fem", 0.0), ("fem", 0.010), ("fem", 0.0145),
                                              ("fem-coarse", None))
"""Tier and element size [m]: None is the mesh of a press, finer under the ball; 0 is the tier's own, everywhere."""


def errors(tier: str, resolution: float | None) -> tuple[list[dict[str, object]], float]:
    """Rows of one mesh, a depth each, and the CPU time of all touches [s]."""
    scene = load_scene(find_scene("indent-homogeneous")).sample(0)
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, resolution=resolution or None))
    model = tiers.build(scene, tier, focus=np.array([[0.0, 0.0, 0.045]]) if resolution is None else None)
    curve = references.load("s1")
    high = model.mesh.points[:, 2].max()
    top = np.flatnonzero((model.mesh.points[model.mesh.faces][:, :, 2] > high - 1e-9).all(axis=1))
    middle = np.linalg.norm(model.mesh.points[model.mesh.faces[top]].mean(axis=1)[:, :2], axis=1).argmin()
    edge = float(np.sqrt(2.0 * model.mesh.face_area()[top[middle]]))
    poses = np.tile(np.eye(4), (len(DEPTHS), len(PLACES), 1, 1))
    poses[:, :, :2, 3] = edge * PLACES
    poses[:, :, 2, 3] = (high + 0.02 - np.array(DEPTHS))[:, None]
    began = time.process_time()
    frames = Solver(model, scene.probe, options=tiers.options(tier)).run(poses)
    spent = time.process_time() - began
    out: list[dict[str, object]] = []
    for t, depth in enumerate(DEPTHS):
        exact = np.interp(depth, curve["depth_m"], curve["force_N"])
        error = np.where(frames.converged[t], frames.force[t, :, 2], np.nan) / exact - 1.0
        out.append({"tier": tier, "edge": edge, "depth": depth, "radius": float(np.sqrt(0.02 * depth) / edge),
                    "least": float(np.nanmin(error)), "most": float(np.nanmax(error)),
                    "penetration": float(frames.penetration[t].max() / edge),
                    "converged": float(frames.converged[t].mean())})
    return out, spent


def measure(*, balls: int = 0, progress: Progress = lambda said: None) -> Measurement:
    """Error against depth on all meshes, and of so many random ``balls`` a tier, see `measurements.resolution`."""
    rows: list[dict[str, object]] = []
    for tier, resolution in MESHES:
        progress(f"{tier}, elements of {'the press' if resolution is None else f'{1e3 * resolution:g} mm'} ...")
        rows += errors(tier, resolution)[0]
    columns = [Column("tier", "tier"), Column("edge", "element", "m", "mm", ".1f"),
               Column("depth", "depth", "m", "mm", ".1f"),
               Column("radius", "contact radius (R d)^(1/2) / element", "1", "", ".2f"),
               Column("least", "least error", "1", "%", "+.1f"), Column("most", "largest", "1", "%", "+.1f"),
               Column("penetration", "penetration / element", "1", "%", ".2f"),
               Column("converged", "converged", "1", "%", ".0f")]
    more = random_balls.measure(balls=balls, progress=progress).tables if balls else []
    return Measurement.of("shallow", {"places": PLACES.tolist()}, [
        Table("force of S1's ball at six places within an element, against references/s1.json", columns, rows,
              name="shallow"), *more])
