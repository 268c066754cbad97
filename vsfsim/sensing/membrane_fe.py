"""Finite elements of a thin membrane over air, in NumPy: the force estimator's model of the sensor.

They are independent of the simulator's elements in `vsfsim.physics`, and work on the read-out mesh of linear triangles.

    plane stress   K_e = A B^T D B in the plane of each triangle, D of modulus times thickness E h [N/m] and nu
    neo-Hookean    W = mu h / 2 (tr C + 1 / det C - 3) per reference area; incompressible, plane stress (Treloar 1943)
    air            force p a_i on node i, a_i a third of the area vectors of the triangles around it
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from vsfsim.core.errors import VsfsimError


class SensorError(VsfsimError):
    """An invalid mesh, state or parameter of a bubble."""


def checked_mesh(points: np.ndarray, triangles: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) [m] and triangles (m, 3) as float64 and int64.

    Raises:
        SensorError: a wrong shape, a point that is not finite, an index out of range, or a triangle without area.
    """
    points, triangles = np.asarray(points, np.float64), np.asarray(triangles)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise SensorError(f"{where}: points have shape {points.shape}; give finite positions (n, 3) in metres.")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0 or triangles.dtype.kind not in "iu":
        raise SensorError(f"{where}: triangles have shape {triangles.shape} and dtype {triangles.dtype}; give whole "
                          f"numbers (m, 3), m >= 1.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise SensorError(f"{where}: a triangle names point {int(triangles.max())} of {len(points)}; indices go from 0 "
                          f"to {len(points) - 1}.")
    flat = np.flatnonzero(np.linalg.norm(area_vectors(points, triangles), axis=1) <= 0.0)
    if len(flat):
        raise SensorError(f"{where}: triangle {int(flat[0])} has no area; remove it or mend the mesh.")
    return points, triangles.astype(np.int64)


def area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area times unit normal of each triangle (m, 3) [m^2]; points (n, 3) [m]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def nodal_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area vectors around each node (n, 3) [m^2]: times a pressure it is the air's force on the node."""
    out = np.zeros_like(points)
    np.add.at(out, triangles, area_vectors(points, triangles)[:, None, :] / 3.0)
    return out


def nodal_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Outward unit normal at each node (n, 3), weighted by area."""
    area = nodal_areas(points, triangles)
    return area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)


def assemble(triangles: np.ndarray, elements: np.ndarray, nodes: int) -> sparse.csr_matrix:
    """Sum of element matrices (m, 9, 9), rows node by node, as a sparse matrix (3 n, 3 n)."""
    index = (3 * triangles[:, :, None] + np.arange(3)).reshape(len(triangles), 9)
    row = np.repeat(index, 9, axis=1).ravel()
    column = np.tile(index, (1, 9)).ravel()
    return sparse.csr_matrix((elements.ravel(), (row, column)), shape=(3 * nodes, 3 * nodes))


def _gradients(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """In-plane axes (m, 2, 3), gradients of the shape functions along them (m, 3, 2) [1/m] and areas (m,) [m^2]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    vector = area_vectors(points, triangles)
    area = np.linalg.norm(vector, axis=1)
    e1 = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    e2 = np.cross(vector / area[:, None], e1)
    axes = np.stack([e1, e2], axis=1)
    edges = np.stack([b - a, c - a], axis=2)  # (m, 3, 2)
    inverse = np.linalg.inv(axes @ edges)  # (m, 2, 2), rows: the gradients of nodes 1 and 2
    return axes, np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1), area


def plane_stress_stiffness(points: np.ndarray, triangles: np.ndarray, stiffness: float, *,
                           poisson_ratio: float = 0.5) -> sparse.csr_matrix:
    """Linear stiffness (3 n, 3 n) [N/m] of a membrane about ``points`` (n, 3) [m].

    Args:
        stiffness: Young's modulus times thickness, E h [N/m].
        poisson_ratio: nu, -1 < nu < 1; 0.5 is incompressible, which plane stress allows [-].
    """
    axes, gradient, area = _gradients(points, triangles)
    d = stiffness / (1.0 - poisson_ratio**2) * np.array([[1.0, poisson_ratio, 0.0], [poisson_ratio, 1.0, 0.0],
                                                         [0.0, 0.0, 0.5 * (1.0 - poisson_ratio)]])
    # strain of node a moving along in-plane axis i, then along x, y, z
    b = np.zeros((len(triangles), 3, 3, 2))
    b[:, 0, :, 0], b[:, 1, :, 1] = gradient[..., 0], gradient[..., 1]
    b[:, 2, :, 0], b[:, 2, :, 1] = gradient[..., 1], gradient[..., 0]
    b = np.einsum("msai,mix->msax", b, axes).reshape(len(triangles), 3, 9)
    return assemble(triangles, area[:, None, None] * np.einsum("msi,st,mtj->mij", b, d, b), len(points))


def pressure_stiffness(points: np.ndarray, triangles: np.ndarray) -> sparse.csr_matrix:
    """Change of `nodal_areas` with the positions (3 n, 3 n) [m]: times -p it is the air's part of the tangent."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    # area vector = (a x b + b x c + c x a) / 2; its change with corner a is da x (b - c) / 2, cyclic in a, b, c
    opposite = np.stack([b - c, c - a, a - b], axis=1)  # (m, 3 corners, 3)
    cross = np.zeros((len(triangles), 3, 3, 3))  # [corner, out, in] of v -> v x opposite
    for corner in range(3):
        x, y, z = opposite[:, corner].T
        cross[:, corner, 0, 1], cross[:, corner, 0, 2] = z, -y
        cross[:, corner, 1, 0], cross[:, corner, 1, 2] = -z, x
        cross[:, corner, 2, 0], cross[:, corner, 2, 1] = y, -x
    # every corner takes a third of the whole
    element = np.broadcast_to(np.moveaxis(cross, 1, 2)[:, None] / 6.0, (len(triangles), 3, 3, 3, 3))
    return assemble(triangles, element.reshape(len(triangles), 9, 9), len(points))


class NeoHookeanMembrane:
    """An incompressible neo-Hookean membrane whose stress-free state is flat.

    Args:
        reference: stress-free material coordinates of the nodes (n, 2) [m].
        triangles: (m, 3).
        shear: mu times the stress-free thickness, mu h = E h / 3 [N/m], one number or (m,).

    Raises:
        SensorError: a triangle that is flat or wound the other way in the reference, or a shear that is not positive.
    """

    def __init__(self, reference: np.ndarray, triangles: np.ndarray, shear: float | np.ndarray):
        reference = np.asarray(reference, np.float64)
        edges = np.stack([reference[triangles[:, 1]] - reference[triangles[:, 0]],
                          reference[triangles[:, 2]] - reference[triangles[:, 0]]], axis=2)
        area = 0.5 * np.linalg.det(edges)
        if not (area > 0.0).all():
            raise SensorError(f"membrane: reference triangle {int(np.argmin(area))} has area {area.min():.3g} m^2; all "
                              f"must be wound the same way, area > 0.")
        self.shear = np.broadcast_to(np.asarray(shear, np.float64), area.shape)
        if not (np.isfinite(self.shear).all() and (self.shear > 0.0).all()):
            raise SensorError(f"membrane: mu h is {shear!r}; it must be greater than 0, in newtons per metre.")
        self.triangles, self.area, self.nodes = triangles, area, len(reference)
        inverse = np.linalg.inv(edges)
        self.gradient = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # (m, 3, 2)

    def _strain(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        f = np.einsum("max,mai->mxi", points[self.triangles], self.gradient)
        c = np.einsum("mxi,mxj->mij", f, f)
        det = c[:, 0, 0] * c[:, 1, 1] - c[:, 0, 1] ** 2
        if not (det > 0.0).all():
            raise SensorError(f"membrane: triangle {int(np.argmin(det))} is squashed flat; the positions are not those "
                              f"of a sensor.")
        return f, c, det, np.linalg.inv(c)

    def energy(self, points: np.ndarray) -> float:
        """Elastic energy [J] at positions (n, 3) [m]."""
        _, c, det, _ = self._strain(points)
        return float((0.5 * self.shear * self.area * (c[:, 0, 0] + c[:, 1, 1] + 1.0 / det - 3.0)).sum())

    def forces(self, points: np.ndarray) -> np.ndarray:
        """+dE/dx (n, 3) [N]: what must act on the nodes from outside to hold the membrane at ``points`` (n, 3) [m]."""
        f, _, det, inverse = self._strain(points)
        stress = (self.shear * self.area)[:, None, None] * (np.eye(2) - inverse / det[:, None, None])
        out = np.zeros((self.nodes, 3))
        np.add.at(out, self.triangles, np.einsum("mxi,mij,maj->max", f, stress, self.gradient))
        return out

    def tangent(self, points: np.ndarray) -> sparse.csr_matrix:
        """Change of `forces` with the positions (3 n, 3 n) [N/m]."""
        f, _, det, inverse = self._strain(points)
        scale = self.shear * self.area
        stress = scale[:, None, None] * (np.eye(2) - inverse / det[:, None, None])
        geometric = np.einsum("mai,mij,mbj->mab", self.gradient, stress, self.gradient)
        # dC for node b moving along y, then dS = mu h / det (C^-1 (C^-1 : dC) + C^-1 dC C^-1)
        half = np.einsum("mbi,myj->mbyij", self.gradient, f)
        dc = half + np.swapaxes(half, 3, 4)
        trace = np.einsum("mij,mbyij->mby", inverse, dc)
        ds = (scale / det)[:, None, None, None, None] * (trace[..., None, None] * inverse[:, None, None]
                                                         + np.einsum("mik,mbykl,mlj->mbyij", inverse, dc, inverse))
        element = np.einsum("mxi,mbyij,maj->maxby", f, ds, self.gradient)
        element += np.einsum("mab,xy->maxby", geometric, np.eye(3))
        return assemble(self.triangles, element.reshape(len(self.triangles), 9, 9), self.nodes)
