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
    points, rest, faces, region = [], [], [], []
    count = 0

    def add(now: np.ndarray, before: np.ndarray, triangles: np.ndarray, kind: int) -> None:
        nonlocal count
        points.append(now)
        rest.append(before)
        faces.append(triangles + count)
        region.append(np.full(len(triangles), kind))
        count += len(now)

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
            angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
            ring0 = ring1 = plant.radius[i] * (np.cos(angle)[:, None] * a + np.sin(angle)[:, None] * np.cross(x, a))
            k = np.arange(_SIDES)
            j = (k + 1) % _SIDES
            triangles = np.concatenate([np.stack([k, j, j + _SIDES], 1), np.stack([k, j + _SIDES, k + _SIDES], 1),
                                        np.stack([np.full(_SIDES - 2, _SIDES), _SIDES + k[1:-1], _SIDES + k[2:]], 1)])
        now = np.concatenate([nodes[p] + product(ring0, turns[p].T), nodes[i] + product(ring1, turns[i].T)])
        add(now, np.concatenate([plant.nodes[p] + ring0, plant.nodes[i] + ring1]), triangles, int(look[i]))
    appearance = plant.appearance
    if pot and plant.pot is not None:
        grey = Appearance(np.full((int(look.max()) + 1, 3), 0.4), ("plain",) * (int(look.max()) + 1),
                          np.ones(int(look.max()) + 1), np.zeros(int(look.max()) + 1))
        appearance = appearance or grey
        kinds = len(appearance.texture)
        k = np.arange(_POT_SIDES)
        j = (k + 1) % _POT_SIDES
        circle = np.stack([np.cos(2 * np.pi * k / _POT_SIDES), np.sin(2 * np.pi * k / _POT_SIDES),
                           np.zeros(_POT_SIDES)], 1)
        up = np.array([0.0, 0.0, plant.pot.height])
        wall = np.concatenate([plant.pot.radius_bottom * circle, plant.pot.radius_top * circle + up])
        add(wall, wall, np.concatenate([np.stack([k, j, j + _POT_SIDES], 1),
                                        np.stack([k, j + _POT_SIDES, k + _POT_SIDES], 1)]), kinds)
        soil = np.concatenate([plant.pot.radius_top * circle + up, up[None]])
        add(soil, soil, np.stack([k, j, np.full(_POT_SIDES, _POT_SIDES)], 1), kinds + 1)
        appearance = Appearance(np.concatenate([appearance.albedo, [_POT_COLOUR, _SOIL_COLOUR]]),
                                (*appearance.texture, "plain", "noise"),
                                np.append(appearance.texture_scale, [0.02, 0.01]),
                                np.append(appearance.texture_contrast, [0.0, 0.3]))
    return Surface(np.concatenate(points), np.concatenate(faces), np.concatenate(region), appearance,
                   np.concatenate(rest))


def plant_view(plant: Plant, intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int, *, device: str,
               renderer: str) -> View:
    """A picture of plant and pot; mask and depth are the plant's alone, so that no touch aims at the pot."""
    whole = render(plant_surface(plant, pot=True), intrinsics, pose, width, height, device=device, renderer=renderer)
    bare = render(plant_surface(plant, pot=False), intrinsics, pose, width, height, device=device, renderer=renderer)
    mask = bare.mask & (bare.depth <= whole.depth + 1e-5)
    return dataclasses.replace(whole, depth=np.where(mask, bare.depth, 0.0).astype(np.float32), mask=mask)


def triangles_of(plant: Plant) -> np.ndarray:
    """Number of triangles of `plant_surface` for each segment (n,); they are in the order of the segments."""
    return np.where(plant.half_width > 0.0, 2, 3 * _SIDES - 2) * (np.arange(len(plant.nodes)) > 0)
