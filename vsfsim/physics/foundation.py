"""The tier `vsf`: every node is an anchor, and the body an elastic foundation.

    pressure = u / integral(dz / M(z)),     M = E (1 - nu) / ((1 + nu) (1 - 2 nu))

over the thickness of the body under a point of its surface, along the inward normal: layers in series, none of which
moves sideways (Winkler 1867; Johnson 1985, section 4.3). It is a compressible layer that is held below and thinner than
the contact is wide. It models where and how deep the probe touches and the layers under it. It does not couple
neighbouring points: there is no bulging, no dent wider than the contact, and no bending. On a thick body the force has
an error of tens of per cent, which grows without bound as nu goes to 1/2.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.physics.elements import anchor
from vsfsim.physics.elements.block import Block
from vsfsim.physics.laws.law import confined_modulus
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.mesh.surface_distance import crossings

MOST_POISSON_RATIO = 0.47  # above it a layer squeezes out sideways long before it is compressed
# of a triangle's area to its corners and to its edge nodes, by the diagonal of the consistent mass matrix (Hinton, Rock
# and Zienkiewicz 1976): row sums would give the corners nothing
_SHARES = np.array([3.0, 3.0, 3.0, 16.0, 16.0, 16.0]) / 57.0
_LAYERS = 32  # samples of E(x) through the thickness
_CHUNK = 128  # rays against all triangles at once


def inward_thickness(mesh: QuadraticMesh, nodes: np.ndarray, inward: np.ndarray) -> np.ndarray:
    """Way through the body from ``nodes`` (s,) along ``inward`` (s, 3) to where it ends (s,) [m]. A node of a curved
    face lies outside the flat triangles beside it, which its ray passes without ending."""
    reach = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    out = np.full(len(nodes), np.inf)
    for start in range(0, len(nodes), _CHUNK):
        part = slice(start, start + _CHUNK)
        way = crossings(mesh.points[nodes[part]], inward[part], mesh.points[mesh.faces[:, :3]])
        beside = (mesh.faces == nodes[part, None, None]).any(axis=2)
        out[part] = np.where((way > 1e-6 * reach) & ~beside, way, np.inf).min(axis=1)
    # a ray that slips through an edge of the surface: as thick as the body is elsewhere
    usual = np.median(out[np.isfinite(out)]) if np.isfinite(out).any() else reach
    return np.where(np.isfinite(out), out, usual)


def foundation(mesh: QuadraticMesh, young_modulus: np.ndarray, poisson_ratio: float) -> tuple[Block, ...]:
    """An anchor on every node.

    A surface node carries its part of the surface. One inside carries kappa V with kappa = M / h^2, h the mean
    thickness: nothing touches it, and only gravity moves it.

    Args:
        mesh: the mesh in the world frame.
        young_modulus: Young's modulus at the Gauss points (m, 4) [Pa].
        poisson_ratio: nu, at most `MOST_POISSON_RATIO` [-].
    """
    a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a)
    normal, area = np.zeros_like(mesh.points), np.zeros(len(mesh.points))
    for k in range(6):
        np.add.at(normal, mesh.faces[:, k], outward)
        np.add.at(area, mesh.faces[:, k], _SHARES[k] * mesh.face_area())
    nodes = mesh.surface_nodes()
    size = np.linalg.norm(normal[nodes], axis=1)
    inward = -normal[nodes] / np.maximum(size, 1e-300)[:, None]
    thickness = inward_thickness(mesh, nodes, inward)
    middle = (np.arange(_LAYERS) + 0.5) / _LAYERS
    at = mesh.points[nodes][:, None, :] + (thickness[:, None] * middle)[:, :, None] * inward[:, None, :]
    modulus = confined_modulus(young_modulus.mean(axis=1), poisson_ratio)
    tree = cKDTree(mesh.points[mesh.tets[:, :4]].mean(axis=1))
    softness = (1.0 / modulus[tree.query(at)[1]]).mean(axis=1) * thickness
    volume, weighted = np.zeros(len(mesh.points)), np.zeros(len(mesh.points))
    np.add.at(volume, mesh.tets, np.repeat(mesh.volume[:, None] / 10.0, 10, axis=1))
    np.add.at(weighted, mesh.tets, np.repeat((modulus * mesh.volume)[:, None] / 10.0, 10, axis=1))
    stiffness = weighted / thickness.mean() ** 2
    stiffness[nodes] = area[nodes] / softness
    return (anchor.block(np.arange(len(mesh.points)), stiffness),)
