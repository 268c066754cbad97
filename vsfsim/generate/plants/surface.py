"""A plant as triangles for the cameras: tubes, cards and the pot."""

from __future__ import annotations

import dataclasses

import numpy as np

from vsfsim.core.plant import Plant
from vsfsim.core.solid import Appearance
from vsfsim.core.system.exact import product
from vsfsim.data.records import View
from vsfsim.sensing.camera import render
from vsfsim.sensing.surface import Surface

_SIDES, _POT_SIDES = 8, 40
_POT_COLOUR, _SOIL_COLOUR = (0.42, 0.17, 0.08), (0.06, 0.04, 0.03)


def plant_surface(plant: Plant, *, pot: bool, nodes: np.ndarray | None = None,
                  turns: np.ndarray | None = None) -> Surface:
    """The surface of a plant for the cameras.

    Args:
        plant: the plant.
        pot: whether the pot and its soil are drawn too.
        nodes: where the nodes are (n, 3) [m]; None at rest.
        turns: rotations of the nodes since rest (n, 3, 3) [-]; None at rest.
    """
    nodes = plant.nodes if nodes is None else nodes
    turns = np.tile(np.eye(3), (len(nodes), 1, 1)) if turns is None else turns
    look = plant.region if plant.look is None else plant.look
    points: list[np.ndarray] = []
    rest, faces, region = [], [], []

    def add(now: np.ndarray, before: np.ndarray, triangles: np.ndarray, kind: int) -> None:
        faces.append(triangles + sum(len(p) for p in points))
        points.append(now)
        rest.append(before)
        region.append(np.full(len(triangles), kind))

    circle, tube = _circle(_SIDES), _tube(_SIDES)
    top = np.arange(_SIDES, 2 * _SIDES)
    tube = np.concatenate([tube, np.stack([np.full(_SIDES - 2, _SIDES), top[1:-1], top[2:]], 1)])
    for i in range(1, len(nodes)):
        p = plant.parent[i]
        x = plant.nodes[i] - plant.nodes[p]
        x = x / np.linalg.norm(x)
        if plant.half_width[i] > 0.0:
            side = plant.half_width[i] * np.cross(plant.blade_normal[i], x)
            start = plant.half_width[p] / plant.half_width[i] if plant.half_width[p] > 0.0 else 0.4
            ring0, ring1 = np.stack([-side, side]) * start, np.stack([-side, side])
            triangles = np.array([[0, 1, 3], [0, 3, 2]])
        else:
            a = np.cross(x, np.eye(3)[np.abs(x).argmin()])
            a /= np.linalg.norm(a)
            ring0 = ring1 = plant.radius[i] * (circle[:, :1] * a + circle[:, 1:2] * np.cross(x, a))
            triangles = tube
        now = np.concatenate([nodes[p] + product(ring0, turns[p].T), nodes[i] + product(ring1, turns[i].T)])
        add(now, np.concatenate([plant.nodes[p] + ring0, plant.nodes[i] + ring1]), triangles, int(look[i]))
    appearance, kinds = plant.appearance, int(look.max()) + 1
    if pot and plant.pot is not None:
        appearance = appearance or Appearance(np.full((kinds, 3), 0.4), ("plain",) * kinds,
                                              np.ones(kinds), np.zeros(kinds))
        kinds, circle = len(appearance.texture), _circle(_POT_SIDES)
        up = np.array([0.0, 0.0, plant.pot.height])
        rim = plant.pot.radius_top * circle + up
        wall, soil = np.concatenate([plant.pot.radius_bottom * circle, rim]), np.concatenate([rim, up[None]])
        add(wall, wall, _tube(_POT_SIDES), kinds)
        k = np.arange(_POT_SIDES)
        add(soil, soil, np.stack([k, (k + 1) % _POT_SIDES, np.full(_POT_SIDES, _POT_SIDES)], 1), kinds + 1)
        appearance = Appearance(np.concatenate([appearance.albedo, [_POT_COLOUR, _SOIL_COLOUR]]),
                                (*appearance.texture, "plain", "noise"),
                                np.append(appearance.texture_scale, [0.02, 0.01]),
                                np.append(appearance.texture_contrast, [0.0, 0.3]))
    return Surface(np.concatenate(points), np.concatenate(faces), np.concatenate(region),
                   appearance, np.concatenate(rest))


def _circle(sides: int) -> np.ndarray:
    """Points of a circle of radius 1 in the plane z = 0 (sides, 3)."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], 1)


def _tube(sides: int) -> np.ndarray:
    """Triangles (2 sides, 3) between two rings of so many points, the second numbered after the first."""
    k = np.arange(sides)
    j = (k + 1) % sides
    return np.concatenate([np.stack([k, j, j + sides], 1), np.stack([k, j + sides, k + sides], 1)])


def plant_view(plant: Plant, intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int, *,
               device: str, renderer: str) -> View:
    """A picture of plant and pot; mask and depth are the plant's alone, so that no touch aims at the pot."""
    whole = render(plant_surface(plant, pot=True), intrinsics, pose, width, height, device=device, renderer=renderer)
    bare = render(plant_surface(plant, pot=False), intrinsics, pose, width, height, device=device, renderer=renderer)
    mask = bare.mask & (bare.depth <= whole.depth + 1e-5)
    return dataclasses.replace(whole, depth=np.where(mask, bare.depth, 0.0).astype(np.float32), mask=mask)


def triangles_of(plant: Plant) -> np.ndarray:
    """Number of triangles of `plant_surface` for each segment (n,); they are in the order of the segments."""
    return np.where(plant.half_width > 0.0, 2, 3 * _SIDES - 2) * (np.arange(len(plant.nodes)) > 0)
