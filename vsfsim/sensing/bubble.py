"""Read-outs of a bubble in every frame: chamber pressure, nodes of the read-out mesh, forces on them, mount wrench.

The solver's mesh and the read-out mesh may differ. Both are meshes of the same flat skin, so each node of one lies in a
triangle of the other by its material coordinates: those of the flat ellipse before inflation.
"""

from __future__ import annotations

import numpy as np

from vsfsim.physics.bubble.sensor import BubbleModel, FlatMesh, containing, interpolation

_SLACK = 1e-9  # a barycentric weight below this size is treated as zero: the point lies on an edge


def locate(points: np.ndarray, flat: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle of a mesh, nodes ``flat`` (n, 2) [m] and ``faces`` (m, 3), that holds each of ``points`` (k, 2) [m].

    A point outside the mesh takes the nearest point of the triangle whose smallest weight is largest. Such points exist
    because the rims are polygons, and a finer polygon bulges further.

    Returns:
        Nodes of the triangles (k, 3), and barycentric weights of the points in them (k, 3).
    """
    triangle, weight = containing(flat, faces, points)
    for k in np.flatnonzero(weight.min(axis=1) < -_SLACK):
        weight[k] = _nearest(points[k], flat[faces[triangle[k]]])
    weight = np.where(np.abs(weight) < _SLACK, 0.0, weight)
    weight /= weight.sum(axis=1, keepdims=True)
    return faces[triangle], weight


def _nearest(point: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Barycentric weights (3,) of the point of a triangle (3, 2) nearest to ``point`` (2,) outside it."""
    best, weight = np.inf, np.zeros(3)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corner[j] - corner[i]
        share = float(np.clip((point - corner[i]) @ edge / (edge @ edge), 0.0, 1.0))
        far = float(np.linalg.norm(corner[i] + share * edge - point))
        if far < best:
            best, weight = far, np.zeros(3)
            weight[i], weight[j] = 1.0 - share, share
    return weight


class BubbleReadout:
    """Transfer of positions and forces from the solver's mesh to the read-out mesh.

    Args:
        flat: nodes of the solver's mesh of the flat skin (n, 2) [m].
        faces: its triangles (m, 3).
        readout: mesh of the read-out; if it is the same, nodes and forces pass unchanged.
    """

    def __init__(self, flat: np.ndarray, faces: np.ndarray, readout: FlatMesh):
        self.readout = readout
        self._corners, share = locate(flat, readout.flat, readout.faces)
        self._up = interpolation(self._corners, share, len(readout.flat))
        self._down = interpolation(*locate(readout.flat, flat, faces), len(flat))
        self._same = np.array_equal(flat, readout.flat) and np.array_equal(faces, readout.faces)

    def positions(self, points: np.ndarray) -> np.ndarray:
        """Read-out nodes (T, N, 3) [m] of solver nodes (T, n, 3) [m]."""
        return points.copy() if self._same else np.stack([self._down @ x for x in points])

    def forces(self, points: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Forces on the read-out nodes (T, N, 3) [N] that are equivalent to nodal forces on the solver's mesh.

        Each force is distributed to the three corners of its triangle by its barycentric weights. Where the skin is
        curved, the force acts outside the triangle's plane; a couple within the triangle restores its moment. Net
        force and net moment of every nodal force are therefore conserved.

        Args:
            points: solver nodes (T, n, 3) [m].
            force: on these nodes (T, n, 3) [N].
        """
        if self._same:
            return force.copy()
        return np.stack([self._transfer(x, f) for x, f in zip(points, force, strict=True)])

    def _transfer(self, points: np.ndarray, force: np.ndarray) -> np.ndarray:
        nodes = self._down @ points
        out = self._up.T @ force
        couple = np.cross(points - self._up @ nodes, force)
        corners = nodes[self._corners]
        arm = corners - corners.mean(axis=1, keepdims=True)
        inertia = np.einsum("kai,kai->k", arm, arm)[:, None, None] * np.eye(3) - np.einsum("kai,kaj->kij", arm, arm)
        turn = np.linalg.solve(inertia, couple[..., None])[..., 0]
        np.add.at(out, self._corners, np.cross(turn[:, None], arm))
        return out


def readout_of(model: BubbleModel) -> BubbleReadout:
    """The read-out of a bubble from `vsfsim.physics.bubble.sensor.build_bubble` on the published mesh of 390 nodes."""
    return BubbleReadout(model.flat, model.mesh.faces, model.read_out)
