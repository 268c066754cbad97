"""Fields on the boundary of a pressed body: the deformed surface to draw, and contact pressure."""

from __future__ import annotations

import numpy as np

from vsfsim.physics.contact.patch import shape_values, subdivided
from vsfsim.physics.mesh.quadratic import QuadraticMesh

_SPLIT = 3  # parts of an edge of a quadratic triangle that is drawn


def deformed_surface(mesh: QuadraticMesh, displacement: np.ndarray, *, parts: int = _SPLIT,
                     ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The deformed boundary: every quadratic triangle is cut into ``parts``^2 flat ones.

    Args:
        mesh: the body.
        displacement: of its nodes (n, 3) [m].
        parts: of an edge of a quadratic triangle.

    Returns:
        Vertices (v, 3) [m]; triangles (g, 3); the boundary triangle of each (g,); length of the displacement at its
        middle (g,) [m].
    """
    moved, cut = mesh.points + displacement, subdivided(parts)
    shape = shape_values(cut.reshape(-1, 3))
    points = np.einsum("sa,fac->fsc", shape, moved[mesh.faces]).reshape(-1, 3)
    length = np.linalg.norm(np.einsum("sa,fac->fsc", shape, displacement[mesh.faces]), axis=2)
    # Copies of a corner in neighbouring triangles are merged, so that the shading is smooth.
    _, first, same = np.unique(np.round(points / (1e-7 * np.ptp(moved, axis=0).max())).astype(np.int64), axis=0,
                               return_index=True, return_inverse=True)
    return (points[first], same.reshape(-1, 3), np.repeat(np.arange(len(mesh.faces)), len(cut)),
            length.reshape(-1, 3).mean(axis=1))


def face_pressure(mesh: QuadraticMesh, surface_force: np.ndarray) -> np.ndarray:
    """Mean contact pressure on every boundary triangle (f,) [Pa], averaged over about one element.

    A nodal force is distributed to the triangles around its node by area. This is exact for a uniform pressure inside
    the patch, because the corners of a quadratic triangle then carry no force.

    Args:
        mesh: the body.
        surface_force: on the nodes of ``mesh.surface_nodes()`` (s, 3) [N].
    """
    force = np.zeros_like(mesh.points)
    force[mesh.surface_nodes()] = surface_force
    area = mesh.face_area()
    around = np.zeros(len(mesh.points))
    np.add.at(around, mesh.faces, area[:, None])
    share = force / np.where(around > 0.0, around, 1.0)[:, None]
    return np.linalg.norm(share[mesh.faces].sum(axis=1), axis=1)
