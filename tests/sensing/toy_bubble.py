"""A bubble of the tests' own: an elliptic neo-Hookean membrane blown up over sealed air and pushed by chosen forces.

The pushes are known exactly, so what an estimator makes of the displacements can be compared with them.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from vsfsim.physics.elements import gas, triangle
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.sensing.membrane_fe import nodal_areas, nodal_normals, skin_forces

AMBIENT = 101325.0  # [Pa]
STIFFNESS = 680.0  # E h [N/m]
RIM = (0.05725, 0.040)  # semi-axes [m]


def disc(rings: int, *, rim=RIM):
    """Flat points (n, 2), triangles (m, 3) wound upwards, and the rim's indices: ring k holds 6 k points."""
    points, start = [np.zeros((1, 2))], [0]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        start.append(start[-1] + len(points[-1]))
        points.append(k / rings * np.stack([rim[0] * np.cos(angle), rim[1] * np.sin(angle)], axis=1))
    triangles = []
    for k in range(1, rings + 1):
        for side in range(6):
            outer = [start[k] + (side * k + j) % (6 * k) for j in range(k + 1)]
            inner = [start[k - 1] + (side * (k - 1) + j) % max(6 * (k - 1), 1) for j in range(k)]
            triangles += [(inner[j], outer[j], outer[j + 1]) for j in range(k)]
            triangles += [(inner[j], outer[j + 1], inner[j + 1]) for j in range(k - 1)]
    points = np.concatenate(points)
    return points, np.array(triangles), np.arange(start[-1], len(points))


@dataclass
class Toy:
    """flat: material coordinates (n, 2). rest: inflated (n, 3) [m]. triangles, rim. pressure: gauge [Pa]. gas: volume
    [m^3]."""

    flat: np.ndarray
    rest: np.ndarray
    triangles: np.ndarray
    rim: np.ndarray
    pressure: float
    gas: float
    gamma: float = 1.4

    @property
    def free(self):
        return np.setdiff1d(np.arange(3 * len(self.rest)), (3 * self.rim[:, None] + np.arange(3)).ravel())

    def unbalanced(self, x, p):
        """Force of skin and air at ``x`` (n, 3) under the gauge pressure ``p`` that is left on the free degrees of
        freedom, and its change with them."""
        skin = triangle.block(self.triangles, x, self.flat[self.triangles], STIFFNESS)
        air = gas.block(self.triangles, x, pressure=p, volume=1.0, sealed=False)
        out = skin_forces(x, self.triangles, self.flat[self.triangles], STIFFNESS) - p * nodal_areas(x, self.triangles)
        return out.ravel()[self.free], assemble(len(x), (skin, air))[self.free][:, self.free]

    def volume(self, points):
        a, b, c = (points[self.triangles[:, k]] for k in range(3))
        return float(np.einsum("mi,mi->", a, np.cross(b, c)) / 6.0)

    def gauge(self, points):
        """Gauge pressure of the sealed gas at ``points`` [Pa]."""
        gas = self.gas + self.volume(points) - self.volume(self.rest)
        return (AMBIENT + self.pressure) * (self.gas / gas) ** self.gamma - AMBIENT

    def push(self, force, *, start=None):
        """Equilibrium positions (n, 3) and gauge pressure under nodal forces (n, 3) [N] from outside."""
        x = self.rest.copy() if start is None else start.copy()
        free = self.free
        for _ in range(60):
            p = self.gauge(x)
            out, k = self.unbalanced(x, p)
            out -= force.ravel()[free]
            if np.linalg.norm(out) < 1e-10:
                return x, p
            # dp = -gamma (p + ambient) / V dV, a rank-one stiffening that Woodbury takes in
            v = nodal_areas(x, self.triangles).ravel()[free]
            s = self.gamma * (p + AMBIENT) / (self.gas + self.volume(x) - self.volume(self.rest))
            factor = splu(sparse.csc_matrix(k))
            a, b = factor.solve(-out), factor.solve(v)
            step = a - b * (s * v @ a) / (1.0 + s * v @ b)
            size = np.abs(step).max()
            x.ravel()[free] += step * min(1.0, 0.002 / size)
        raise AssertionError(f"the toy bubble found no equilibrium, residual {np.linalg.norm(out):.1e} N")


def bubble(rings, *, pressure=7400.0, gas=150e-6):
    """A `Toy`, blown up from the flat disc in steps of pressure."""
    flat, triangles, rim = disc(rings)
    x = np.concatenate([flat, 0.003 * (1 - (flat[:, :1] / RIM[0]) ** 2 - (flat[:, 1:] / RIM[1]) ** 2)], axis=1)
    toy = Toy(flat, x, triangles, rim, 0.0, gas)
    free = toy.free
    for p in np.linspace(0.02, 1.0, 14) * pressure:
        for _ in range(60):
            out, k = toy.unbalanced(x, p)
            if np.linalg.norm(out) < 1e-10:
                break
            step = splu(sparse.csc_matrix(k)).solve(-out)
            x.ravel()[free] += step * min(1.0, 0.004 / np.abs(step).max())
        else:
            raise AssertionError(f"the toy bubble does not inflate to {p:.0f} Pa")
    toy.rest, toy.pressure = x, pressure
    return toy


def patch(toy, centre, radius, newtons, *, slant=(0.0, 0.0)):
    """Nodal forces (n, 3) [N] of a round patch about ``centre`` (x, y) on the rest dome: Hertz-like, inwards, plus
    ``slant`` times that along x, y."""
    out = np.zeros_like(toy.rest)
    inner = np.setdiff1d(np.arange(len(toy.rest)), toy.rim)
    weight = np.zeros(len(toy.rest))
    far = np.linalg.norm(toy.rest[inner, :2] - centre, axis=1)
    weight[inner] = np.sqrt(np.maximum(1.0 - (far / radius) ** 2,
                                       0.0)) * np.linalg.norm(nodal_areas(toy.rest, toy.triangles)[inner], axis=1)
    out -= weight[:, None] * nodal_normals(toy.rest, toy.triangles)
    out[:, :2] += weight[:, None] * np.asarray(slant)
    return out * newtons / np.linalg.norm(out.sum(axis=0))
