"""A plant of a procedural family in ``scenes/``, by the name that a scene gives; and the same as tetrahedra, for cross-checks."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np

from vsfsim.core.errors import SceneError, did_you_mean
from vsfsim.core.plant import Plant
from vsfsim.core.shape import Family
from vsfsim.core.shelf import families
from vsfsim.core.solid import Solid

_SIDES, _RINGS = 16, 6  # of the surface that is filled: around a branch, and from pole to pole of a joint's ball


def grow(shape: Family, rng: np.random.Generator, *, where: str, number: int = 0) -> Plant:
    """The plant of a family, as object ``number`` of its dataset.

    Raises:
        SceneError: an unknown family, one that makes solid bodies, or a parameter that is wrong.
    """
    if shape.name not in families():
        raise SceneError(f"{where}: unknown family '{shape.name}'. {did_you_mean(shape.name, families())}")
    module = importlib.import_module(f"vsfsim.scenes.{shape.name}")
    if not hasattr(module, "grow"):
        raise SceneError(f"{where}: the family '{shape.name}' makes solid bodies; an arm touches plants so far. Use family = \"plant\", or take [arm] out and give a [probe].")
    return module.grow(shape.parameters, rng, where=where, number=number)


def solid_of(plant: Plant, resolution: float) -> Solid:
    """A plant without blades as tetrahedra: its branches as cylinders, its joints as balls, filled as one body; one region a segment's modulus, E of the nearest segment.

    Its base is the origin: the clamped node's ball stands on z = 0.

    Args:
        resolution: edge length aimed at [m]; half the thinnest radius or less, or the section is not round.

    Raises:
        SceneError: the plant has leaf blades. MeshError: it cannot be filled.
    """
    import trimesh

    from vsfsim.physics.scan import fill

    if (plant.half_width[1:] > 0.0).any():
        raise SceneError("a plant with leaf blades has no tetrahedra: they are thinner than any; grow it with leaves = false.")
    parts = []
    for i in range(1, len(plant.nodes)):
        ends = plant.nodes[[plant.parent[i], i]]
        parts.append(trimesh.creation.cylinder(radius=plant.radius[i], segment=ends, sections=_SIDES))
        for end in ends:
            ball = trimesh.creation.uv_sphere(radius=plant.radius[i], count=[_RINGS, _SIDES])
            ball.apply_translation(end)
            parts.append(ball)
    vertices, tets, notes = fill(trimesh.util.concatenate(parts), resolution, Path("plant"))
    # `fill` moves the base to the origin: back to where the plant stands
    low = np.min([p.bounds[0] for p in parts], axis=0)
    high = np.max([p.bounds[1] for p in parts], axis=0)
    vertices = vertices + np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    centre = vertices[tets].mean(axis=1)
    a, b = plant.nodes[plant.parent[1:]], plant.nodes[1:]
    way = b - a
    s = np.clip(np.einsum("kc,tkc->tk", way, centre[:, None] - a) / (way**2).sum(axis=1), 0.0, 1.0)
    gap = np.linalg.norm(centre[:, None] - a - s[..., None] * way, axis=2) / plant.radius[1:]
    owner = gap.argmin(axis=1)
    names = tuple(f"segment-{i + 1}" for i in range(len(way)))
    return Solid(vertices, tets, owner, names, plant.young_modulus[1:], None, tuple(notes))
