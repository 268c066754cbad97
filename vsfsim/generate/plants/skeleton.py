"""The skeleton of a plant that is displaced a little, everywhere otherwise: what vision errs, or what the last bits
decide."""

from __future__ import annotations

import dataclasses

import numpy as np

from vsfsim.core.plant import Plant

REACH = 0.05
"""Over which the displacement is alike [m]."""
_WAVES = 64  # of the random field


def displaced(plant: Plant, by: float, rng: np.random.Generator) -> Plant:
    """A plant whose nodes are displaced by a smooth random field of the RMS length ``by`` [m] (random Fourier
    features); blades stay across their segments. By 0 it is the plant itself."""
    if not by:
        return plant
    number, phase = rng.normal(size=(3, _WAVES)) / REACH, rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    way = np.cos(plant.nodes @ number + phase) @ rng.normal(size=(_WAVES, 3))
    nodes = plant.nodes + by * way / np.sqrt((way**2).sum(axis=1).mean())
    along = np.zeros_like(nodes)
    along[1:] = nodes[1:] - nodes[plant.parent[1:]]
    along[1:] /= np.linalg.norm(along[1:], axis=1)[:, None]
    normal, blade = plant.blade_normal.copy(), plant.half_width > 0.0
    normal[blade] -= np.einsum("ij,ij->i", normal, along)[blade, None] * along[blade]
    normal[blade] /= np.linalg.norm(normal[blade], axis=1)[:, None]
    return dataclasses.replace(plant, nodes=nodes, blade_normal=normal)
