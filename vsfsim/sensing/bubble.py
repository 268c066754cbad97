"""Read-outs of a bubble in every frame: chamber pressure, nodes of the read-out mesh, forces on them, mount wrench.

The solver's mesh and the read-out mesh may differ. Both are meshes of the same flat skin, so each node of one lies in a
triangle of the other by its material coordinates: those of the flat ellipse before inflation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy import sparse

from vsfsim.physics.mesh.membrane import TriangleMesh

if TYPE_CHECKING:
    from vsfsim.physics.bubble.sensor import BubbleModel

_CHUNK = 2_000_000  # pairs of point and triangle tested together
_SLACK = 1e-9  # a barycentric weight below this size is treated as zero: the point lies on an edge


@dataclass(frozen=True)
class FlatMesh:
    """A mesh of the flat skin."""

    points: np.ndarray
    """Material coordinates (n, 2) [m]."""
    triangles: np.ndarray
    """Node indices, counter-clockwise (m, 3)."""
    rim: np.ndarray
    """True at the clamped nodes (n,)."""


def locate(points: np.ndarray, mesh: FlatMesh) -> tuple[np.ndarray, np.ndarray]:
    """The triangle of ``mesh`` that contains each of the flat ``points`` (k, 2) [m].

    A point outside the mesh takes the nearest point of the triangle whose smallest weight is largest. Such points exist
    because the rims are polygons, and a finer polygon bulges further.

    Returns:
        Nodes of the triangles (k, 3), and barycentric weights of the points in them (k, 3).
    """
    corner = mesh.points[mesh.triangles]
    inverse = np.linalg.inv(np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2))
    rows, step = [], max(1, _CHUNK // len(corner))
    for start in range(0, len(points), step):
        part = points[start:start + step]
        two = np.einsum("mij,kmj->kmi", inverse, part[:, None] - corner[None, :, 0])
        weight = np.concatenate([1.0 - two.sum(axis=2, keepdims=True), two], axis=2)
        best = weight.min(axis=2).argmax(axis=1)
        rows.append((best, weight[np.arange(len(part)), best]))
    triangle, weight = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
    for k in np.flatnonzero(weight.min(axis=1) < -_SLACK):
        weight[k] = _nearest(points[k], corner[triangle[k]])
    weight = np.where(np.abs(weight) < _SLACK, 0.0, weight)
    weight /= weight.sum(axis=1, keepdims=True)
    return mesh.triangles[triangle], weight


def weights(nodes: np.ndarray, weight: np.ndarray, count: int) -> sparse.csr_matrix:
    """The result of `locate` as a matrix (k, count): it interpolates values, and its transpose distributes forces."""
    return sparse.csr_matrix((weight.ravel(), (np.repeat(np.arange(len(nodes)), 3), nodes.ravel())),
                             shape=(len(nodes), count))


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
        solver: flat mesh of the solver.
        readout: flat mesh of the read-out; if it equals ``solver``, nodes and forces pass unchanged.
    """

    def __init__(self, solver: FlatMesh, readout: FlatMesh):
        self.solver, self.readout = solver, readout
        self._corners, share = locate(solver.points, readout)
        self._up = weights(self._corners, share, len(readout.points))
        self._down = weights(*locate(readout.points, solver), len(solver.points))
        self._same = (np.array_equal(solver.points, readout.points)
                      and np.array_equal(solver.triangles, readout.triangles))

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
    def flat(points: np.ndarray, faces: np.ndarray, rim: np.ndarray) -> FlatMesh:
        held = np.zeros(len(points), bool)
        held[rim] = True
        return FlatMesh(points, np.asarray(faces, np.int64), held)

    mesh, published = cast(TriangleMesh, model.mesh), model.read_out
    return BubbleReadout(flat(model.flat, mesh.faces, mesh.rim), flat(published.flat, published.faces, published.rim))
