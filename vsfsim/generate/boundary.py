"""Fields on the boundary of a pressed body: the deformed surface to draw, and contact pressure."""

from __future__ import annotations

import numpy as np

from vsfsim.physics.contact.patch import shape_values
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
    n = parts
    at = np.array([(i, j, n - i - j) for i in range(n, -1, -1) for j in range(n - i, -1, -1)]) / n
    number = {tuple(np.rint(n * row).astype(int)): k for k, row in enumerate(at)}
    cut = []
    for i in range(n):
        for j in range(n - i):
            k = n - 1 - i - j
            a, b, c = number[i + 1, j, k], number[i, j + 1, k], number[i, j, k + 1]
            cut.append((a, b, c))
            if k > 0:
                cut.append((number[i + 1, j + 1, k - 1], number[i, j + 1, k], number[i + 1, j, k]))
    moved = mesh.points + displacement
    shape = shape_values(at)
    points = np.einsum("sa,fac->fsc", shape, moved[mesh.faces])
    length = np.linalg.norm(np.einsum("sa,fac->fsc", shape, displacement[mesh.faces]), axis=2)
    faces = len(mesh.faces)
    triangles = (np.array(cut)[None] + len(at) * np.arange(faces)[:, None, None]).reshape(-1, 3)
    # Copies of a corner in neighbouring triangles are merged, so that the shading is smooth.
    _, first, same = np.unique(np.round(points.reshape(-1, 3) / (1e-7 * np.ptp(moved, axis=0).max())).astype(np.int64),
                               axis=0, return_index=True, return_inverse=True)
    vertices = points.reshape(-1, 3)[first]
    middle = length[:, np.array(cut)].mean(axis=2).reshape(-1)
    return vertices, same.reshape(-1)[triangles], np.repeat(np.arange(faces), len(cut)), middle


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
