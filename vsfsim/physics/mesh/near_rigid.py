"""Parts inside a body that are far stiffer than what surrounds them, with the largest modulus that still matters.

A part whose modulus is a million times that of its surroundings does not strain: it only moves and turns. Newton's
straight steps stretch a part that turns, and the larger the modulus the more steps that costs, for a force that no
longer changes. So the modulus of such a part is limited to

    E <= COMPACT (longest / thickness)^3 E_around,     thickness = 2 volume / area

of its longest extent and its surface. A compact part in a soft matrix strains by about E_around / E of what the matrix
does (for a ball longest / thickness is 3). A slender one bends more easily, by the cube of its slenderness,
and keeps as much more of its modulus. Only parts without a node on the boundary of the body are limited: what loads
them comes through their surroundings.
"""

from __future__ import annotations

import numpy as np

from vsfsim.core.solid import boundary_faces
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.mesh.validity import joined

COMPACT = 40.0
"""Largest modulus of a part over that of its surroundings and over the cube of its slenderness [-]: 1,080 for a ball.
On the block of scenes/indent.toml, pressed 10 mm, the force at a contrast of 1e3 is 0.18 % under that of 1e4, and takes
24 Newton steps in place of 103."""
ENCLOSED = 0.9
"""Part of the volume of the elements next to a part that decides what surrounds it [-]."""


def limited(mesh: QuadraticMesh, young_modulus: np.ndarray) -> tuple[np.ndarray, float]:
    """The moduli with those of nearly rigid parts limited.

    Args:
        mesh: the mesh.
        young_modulus: E at its Gauss points (m, 4) [Pa].

    Returns:
        The moduli (m, 4) [Pa], and the largest factor by which one was lowered, 1 if none was.
    """
    mean = young_modulus.mean(axis=1)
    stiff = mean > COMPACT * mean.min()
    if not stiff.any():
        return young_modulus, 1.0
    out = young_modulus.copy()
    boundary = np.zeros(len(mesh.points), bool)
    boundary[mesh.surface_nodes()] = True
    which = np.flatnonzero(stiff)
    # stiff tetrahedra that share a corner are one part
    label = joined(mesh.tets[which, :4].reshape(-1, 1), np.repeat(np.arange(len(which)), 4), len(which))
    for part in (which[label == k] for k in range(label.max() + 1)):
        nodes = np.zeros(len(mesh.points), bool)
        nodes[mesh.tets[part]] = True
        around = nodes[mesh.tets].any(axis=1)
        around[part] = False
        if (nodes & boundary).any() or not around.any():
            continue
        # a few tetrahedra at the surface of a part hold a mixture of both materials
        surroundings = np.quantile(mean[around], ENCLOSED, weights=mesh.volume[around], method="inverted_cdf")
        out[part] = np.minimum(out[part], COMPACT * _slenderness(mesh, part) ** 3 * surroundings)
    return out, float((young_modulus / out).max())


def _slenderness(mesh: QuadraticMesh, part: np.ndarray) -> float:
    """Longest extent over thickness of a part of the mesh, by its tetrahedra [-]."""
    corners = mesh.tets[part][:, :4]
    a, b, c = np.moveaxis(mesh.points[boundary_faces(corners)[0]], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    at = mesh.points[np.unique(corners)]
    longest = 2.0 * np.linalg.norm(at - at.mean(axis=0), axis=1).max()
    return float(longest * area / (2.0 * mesh.volume[part].sum()))
