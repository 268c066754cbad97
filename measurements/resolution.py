"""Error of the force against how well a mesh resolves the contact: `vsfsim measure shallow --balls 24`.

Random balls are pressed at random places into a block on coarse elements, and on a mesh that is refined at the contact.
`vsfsim/physics/mesh/resolved.py` has the relation that was read from it.
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from pathlib import Path

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import Scene, parse_scene
from vsfsim.physics import tiers
from vsfsim.physics.mesh.edge_refine import EdgePath
from vsfsim.physics.mesh.resolved import SHARE
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import Frames
from vsfsim.physics.solve.touches import Solver

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = [0.1, 0.1, 0.05] }}
poisson_ratio = {ratio}
young_modulus = 1e4
resolution = {edge}
[probe]
shape = {{ sphere = {radius} }}
"""
DEPTHS = np.array([0.08, 0.2, 0.4, 0.7, 1.0])
"""Depths over the largest of a ball, which is 1.5 radii, 15 mm at most [-]."""
BALLS = {"fem-coarse": (24, 1), "fem": (16, 2)}
"""Number of balls and seed of each tier."""
BINS = (0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.7, 1.0, np.inf)
"""Of the contact radius over the element [-]."""


def pressed(model: Model, scene: Scene, at: np.ndarray, depths: np.ndarray, tier: str) -> Frames:
    """The ball of a scene at ``at`` (2,) [m] and ``depths`` (T,) [m]."""
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    poses[:, 0, :2, 3] = at
    poses[:, 0, 2, 3] = model.mesh.points[:, 2].max() + scene.probe.radius - depths
    return Solver(model, scene.probe, options=tiers.options(tier)).run(poses)


def errors(tier: str, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Contact radius over element and error of the force [-] at each depth of one random ball."""
    radius = float(np.exp(rng.uniform(np.log(0.002), np.log(0.025))))
    edge, ratio = float(rng.uniform(0.007, 0.016)), float(rng.choice([0.3, 0.45, 0.45, 0.48]))
    at, depths = rng.uniform(-0.02, 0.02, 2), min(1.5 * radius, 0.015) * DEPTHS

    def scene(size: float) -> Scene:
        return parse_scene(SCENE.format(radius=radius, edge=size, ratio=ratio), Path("resolution.toml")).sample(0)

    coarse, fine = scene(edge), scene(min(edge, 0.008))
    found = pressed(tiers.build(coarse, tier), coarse, at, depths, tier)
    # two fifths of the contact radius at the second depth
    size = max(min(np.sqrt(radius * depths[1]) / 2.5, radius / 4.0), 4e-4)
    plain = tiers.element_size(dataclasses.replace(fine.object, resolution=None), tier, fine.probe)
    half = size / (tiers.TIERS[tier].probe * min(1.0, tiers.element_size(fine.object, tier, fine.probe) / plain))
    way = EdgePath(np.array([[[*at, 0.06]], [[*at, 0.04]]]), np.array([half]))
    exact = pressed(tiers.build(fine, tier, edges=way), fine, at, depths, tier)
    both = (found.converged & exact.converged)[:, 0]
    error = found.force[:, 0, 2] / exact.force[:, 0, 2] - 1.0
    return list(zip(found.contact_radius[both, 0].tolist(), error[both].tolist(), strict=True))


def measure(*, balls: int | None = None, progress: Progress = lambda said: None) -> Measurement:
    """Error against contact radius over element size; ``balls`` of each tier, None for those of `BALLS`."""
    pairs = []
    for tier, (count, seed) in BALLS.items():
        rng = np.random.default_rng(seed)
        for k in range(count if balls is None else balls):
            progress(f"{tier}, ball {k + 1} ...")
            pairs += errors(tier, rng)
    radius, error = np.array(pairs).T
    rows = []
    for low, high in pairwise(BINS):
        own = np.abs(error[(radius >= low) & (radius < high)])
        if len(own):
            middle = np.median(radius[(radius >= low) & (radius < high)])
            rows.append({"low": low, "high": high, "frames": len(own), "median": float(np.median(own)),
                         "most": float(own.max()), "estimate": float(SHARE / middle**2)})
    columns = [Column("low", "contact radius / element from", "1", "", ".2f"), Column("high", "to", "1", "", ".2f"),
               Column("frames", "frames", "1", "", "d"), Column("median", "median error", "1", "%", ".1f"),
               Column("most", "largest", "1", "%", ".1f"), Column("estimate", "estimate", "1", "%", ".1f")]
    return Measurement.of("resolution", {"balls": balls}, [
        Table("error of the force on coarse elements against elements of two fifths of the contact radius", columns,
              rows, name="resolution")])
