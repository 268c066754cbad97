"""Fields on the boundary of a pressed body: the deformed surface to draw, and contact pressure."""

from __future__ import annotations

import numpy as np

from vsfsim.physics.contact.patch import shape_values, subdivided
from vsfsim.physics.mesh.quadratic import QuadraticMesh

_SPLIT = 3  # parts of an edge of a quadratic triangle that is drawn


def deformed_surface(mesh: QuadraticMesh, displacement: np.ndarray, nodal: np.ndarray | None = None, *,
                     parts: int = _SPLIT) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The deformed boundary: every quadratic triangle is cut into ``parts``^2 flat ones.

    Args:
        mesh: the body.
        displacement: of its nodes (n, 3) [m].
        nodal: values at its nodes (n,); None for the lengths of their displacements [m].
        parts: of an edge of a quadratic triangle.

    Returns:
        Vertices (v, 3) [m]; triangles (g, 3); the boundary triangle of each (g,); the nodal value at its middle
        (g,).
    """
    moved, cut = mesh.points + displacement, subdivided(parts)
    shape = shape_values(cut.reshape(-1, 3))
    points = np.einsum("sa,fac->fsc", shape, moved[mesh.faces]).reshape(-1, 3)
    nodal = np.linalg.norm(displacement, axis=1) if nodal is None else nodal
    value = np.einsum("sa,fa->fs", shape, nodal[mesh.faces])
    # Copies of a corner in neighbouring triangles are merged, so that the shading is smooth.
    _, first, same = np.unique(np.round(points / (1e-7 * np.ptp(moved, axis=0).max())).astype(np.int64), axis=0,
                               return_index=True, return_inverse=True)
    return (points[first], same.reshape(-1, 3), np.repeat(np.arange(len(mesh.faces)), len(cut)),
            value.reshape(-1, 3).mean(axis=1))


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


def node_pressure(mesh: QuadraticMesh, pressure: np.ndarray) -> np.ndarray:
    """Contact pressure at every node (n,) [Pa]: the mean over the boundary triangles around it, with the ``pressure``
    of `face_pressure`."""
    area = np.repeat(mesh.face_area()[:, None], 6, axis=1)
    total, around = (np.bincount(mesh.faces.ravel(), values.ravel(), len(mesh.points))
                     for values in (area * pressure[:, None], area))
    return total / np.where(around > 0.0, around, 1.0)
