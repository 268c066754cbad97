"""Sphere pressed into a soft block: an independent computation of S1 (`s1.json`).

    python references/soft_block.py                  # three meshes (20 minutes of a core), Richardson extrapolation
    python references/soft_block.py --cell 5 --depth 2.5 5

One quarter of the block, isoparametric 27-node hexahedra with 27 Gauss points, total Lagrangian, the neo-Hookean law
W = mu/2 (I_c - 3) - mu ln J + lambda/2 (ln J)^2. The sphere is rigid and frictionless; contact is enforced on Gauss
points of the top faces by a penalty with multipliers (Uzawa), so no penetration is left. Newton's method, line search,
SuperLU. NumPy and SciPy only: nothing of `vsfsim` is used.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg, splu

HERE = Path(__file__).parent


def ticks(cell: float, even: float, length: float, growth: float, widest: float = 0.25) -> np.ndarray:
    """Grid lines (n,) [m] from 0 to ``length``: cells of ``cell`` up to ``even``, then growing by ``growth``.

    No cell is wider than the fraction ``widest`` of the length.
    """
    steps = [cell] * max(1, round(even / cell))
    while sum(steps) < length - 1e-12:
        steps.append(min(steps[-1] * growth, widest * length))
    return np.concatenate([[0.0], np.cumsum(steps)]) * length / sum(steps)


def lagrange(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic shape functions of the nodes -1, 0, 1 at ``at`` (q,) and their derivatives (q, 3), (q, 3)."""
    return (np.stack([0.5 * at * (at - 1.0), 1.0 - at**2, 0.5 * at * (at + 1.0)], axis=1),
            np.stack([at - 0.5, -2.0 * at, at + 0.5], axis=1))


def elements(grid: np.ndarray) -> np.ndarray:
    """Nodes of the 27-node elements (m, 27, ...) of a structured block of nodes (2a+1, 2b+1, 2c+1, ...)."""
    first = np.stack(np.meshgrid(*(np.arange(0, n - 1, 2) for n in grid.shape[:3]), indexing="ij"), axis=-1)
    offset = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[tuple((first.reshape(-1, 1, 3) + offset[None]).transpose(2, 0, 1))]


def with_midpoints(line: np.ndarray) -> np.ndarray:
    """Grid lines (n,) and the middle of each cell, (2n-1,)."""
    return np.sort(np.concatenate([line, 0.5 * (line[1:] + line[:-1])]))


@dataclass
class Block:
    """The part of the block on one side of its planes of symmetry, in 27-node hexahedra."""

    points: np.ndarray
    """Nodes at rest (n, 3) [m]; the sphere comes down at x = y = 0."""
    cells: np.ndarray
    """Nodes of each element (m, 27)."""
    gradients: np.ndarray
    """Of the shape functions at the Gauss points (m, 27, 27, 3) [1/m]: element, point, node, direction."""
    weights: np.ndarray
    """Volume of each Gauss point (m, 27) [m^3]."""
    faces: np.ndarray
    """Nodes of the faces on the top (f, 9)."""
    face_values: np.ndarray
    """Shape functions at the faces' Gauss points (p, 9) [-]."""
    face_weights: np.ndarray
    """Area of each of these points (f, p) [m^2]."""
    free: np.ndarray
    """Numbers of the unknowns that may move (k,)."""
    parts: int
    """Number of such parts that make the whole block."""

    @classmethod
    def quarter(cls, size: tuple[float, float, float], cell: float, even: float, growth: float,
                face_points: int) -> Block:
        """A quarter of a block of ``size`` [m] with cells of ``cell`` [m] within ``even`` [m] of the contact."""
        x, y = (ticks(cell, even, 0.5 * length, growth) for length in size[:2])
        z = size[2] - ticks(cell, even, size[2], growth)[::-1]
        grid = np.stack(np.meshgrid(*map(with_midpoints, (x, y, z)), indexing="ij"), axis=-1)
        return cls.of(grid.reshape(-1, 3), elements(np.arange(grid[..., 0].size).reshape(grid.shape[:3])), (0, 1),
                      face_points)

    @classmethod
    def of(cls, points: np.ndarray, cells: np.ndarray, symmetric: tuple[int, ...], face_points: int) -> Block:
        """Isoparametric elements with the nodes ``points`` (n, 3) [m] and ``cells`` (m, 27).

        The base z = 0 is fixed. For each axis in ``symmetric`` the plane through the origin is a plane of symmetry.

        Raises:
            ValueError: an element has a Jacobian that is not positive.
        """
        gauss, weight = np.polynomial.legendre.leggauss(3)
        n, d = lagrange(gauss)
        reference = np.stack([np.einsum("ai,bj,ck->abcijk", *(d if axis == k else n for k in range(3)))
                              for axis in range(3)], axis=-1).reshape(27, 27, 3)
        jacobian = np.einsum("mai,qak->mqik", points[cells], reference, optimize=True)
        determinant = np.linalg.det(jacobian)
        if determinant.min() <= 0.0:
            raise ValueError("an element has a Jacobian that is not positive.")
        gradients = np.einsum("qak,mqkj->mqaj", reference, np.linalg.inv(jacobian), optimize=True)
        volume = np.einsum("a,b,c->abc", weight, weight, weight).reshape(-1)
        sides = np.concatenate([np.take(cells.reshape(-1, 3, 3, 3), end, axis=axis).reshape(-1, 9)
                                for axis in (1, 2, 3) for end in (0, 2)])
        faces = sides[(points[sides, 2] > points[:, 2].max() - 1e-9).all(axis=1)]
        gauss, weight = np.polynomial.legendre.leggauss(face_points)
        n, d = lagrange(gauss)
        face_values = np.einsum("ai,bj->abij", n, n).reshape(face_points**2, 9)
        along = np.stack([np.einsum("ai,bj->abij", *pair).reshape(face_points**2, 9) for pair in ((d, n), (n, d))])
        area = np.abs(np.linalg.det(np.einsum("fai,kpa->fpik", points[faces][..., :2], along)))
        held = np.zeros(points.shape, bool)
        held[points[:, 2] < 1e-12] = True
        for axis in symmetric:
            held[np.abs(points[:, axis]) < 1e-12, axis] = True
        return cls(points, cells, gradients, determinant * volume, faces, face_values,
                   area * np.outer(weight, weight).reshape(-1), np.flatnonzero(~held.reshape(-1)), 2 ** len(symmetric))


class Press:
    """The block under the sphere: forces, tangent and the Newton iteration.

    Args:
        block: the mesh. young_modulus: [Pa], of all elements or of each (m,). poisson_ratio: [-].
        radius: of the sphere [m].
        penalty: pressure over penetration [Pa/m].
    """

    def __init__(self, block: Block, young_modulus: float | np.ndarray, poisson_ratio: float, radius: float,
                 penalty: float = 1e10):
        self.block, self.radius, self.penalty = block, radius, penalty
        modulus = np.broadcast_to(young_modulus, len(block.cells))[:, None]
        self.mu = modulus / (2.0 * (1.0 + poisson_ratio))
        self.lam = modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
        self.u = np.zeros(block.points.shape)
        self.centre = np.array([0.0, 0.0, block.points[:, 2].max() + radius])
        self.multiplier = np.zeros(block.face_weights.shape)
        self.rate = np.zeros_like(self.u)  # of the displacements per depth in the last stride
        self.factor = None

    def deformation(self, u: np.ndarray) -> np.ndarray:
        """Deformation gradients (m, 27, 3, 3) [-]."""
        return np.eye(3) + np.einsum("mqaj,mai->mqij", self.block.gradients, u[self.block.cells], optimize=True)

    def contact(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Signed distance (f, p) [m], outward normal of the sphere (f, p, 3), and pressure (f, p) [Pa]."""
        x = np.einsum("pa,fai->fpi", self.block.face_values, (self.block.points + u)[self.block.faces]) - self.centre
        length = np.linalg.norm(x, axis=2)
        gap = length - self.radius
        return gap, x / length[..., None], np.maximum(self.multiplier - self.penalty * gap, 0.0)

    def density(self, f: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Energy (m, 27) [Pa] of deformation gradients ``f`` (m, 27, 3, 3) with determinants ``j`` (m, 27) [-]."""
        log = np.log(j)
        return 0.5 * self.mu * ((f**2).sum(axis=(2, 3)) - 3.0) - self.mu * log + 0.5 * self.lam * log**2

    def stress(self, f: np.ndarray) -> np.ndarray:
        """First Piola-Kirchhoff stress (m, 27, 3, 3) [Pa]."""
        inverse = np.swapaxes(np.linalg.inv(f), 2, 3)
        log = np.log(np.linalg.det(f))
        return self.mu[..., None, None] * f + (self.lam * log - self.mu)[..., None, None] * inverse

    def stiffness(self, f: np.ndarray) -> np.ndarray:
        """Of the elements (m, 27, 3, 27, 3) [N/m]."""
        b, m = self.block, len(f)
        inverse = np.swapaxes(np.linalg.inv(f), 2, 3)
        log = np.log(np.linalg.det(f))
        # d2W = mu dF:dF + lambda (H:dF)^2 + (mu - lambda ln J) tr(H^T dF H^T dF) with H the inverse transpose of F
        spatial = np.einsum("mqij,mqaj->mqai", inverse, b.gradients, optimize=True).reshape(m, 27, 81)
        rows = np.swapaxes(spatial, 1, 2)
        whole = (rows @ ((b.weights * self.lam)[..., None] * spatial)).reshape(m, 27, 3, 27, 3)
        crossed = rows @ ((b.weights * (self.mu - self.lam * log))[..., None] * spatial)
        whole += crossed.reshape(m, 27, 3, 27, 3).swapaxes(2, 4)
        flat = b.gradients.swapaxes(1, 2).reshape(m, 27, 81)
        plain = flat @ np.swapaxes(np.repeat(b.weights * self.mu, 3, axis=1)[:, None] * flat, 1, 2)
        for i in range(3):
            whole[:, :, i, :, i] += plain
        return whole

    def energy(self, u: np.ndarray) -> float:
        """Elastic energy and the augmented Lagrangian of the contact [J]; infinite where an element is inverted."""
        f = self.deformation(u)
        j = np.linalg.det(f)
        if j.min() <= 0.0:
            return np.inf
        pressure = self.contact(u)[2]
        return float((self.block.weights * self.density(f, j)).sum()
                     + (self.block.face_weights * pressure**2).sum() / (2.0 * self.penalty))

    def unbalanced(self, u: np.ndarray) -> np.ndarray:
        """Gradient of the energy (n, 3) [N]."""
        out = np.zeros_like(u)
        np.add.at(out, self.block.cells, np.einsum("mq,mqij,mqaj->mai", self.block.weights,
                                                   self.stress(self.deformation(u)), self.block.gradients,
                                                   optimize=True))
        _, normal, pressure = self.contact(u)
        load = np.einsum("fp,fpi,pa->fai", self.block.face_weights * pressure, normal, self.block.face_values)
        np.add.at(out, self.block.faces, -load)
        return out

    def tangent(self, u: np.ndarray, turning: bool = True) -> sparse.csc_matrix:
        """Second derivative on the free unknowns (k, k) [N/m]; without ``turning`` the negative part of the contact's,
        which comes from the turning normal, is left out."""
        b, eye = self.block, np.eye(3)
        gap, normal, pressure = self.contact(u)
        on = b.face_weights * (pressure > 0.0)
        outer = normal[..., :, None] * normal[..., None, :]
        curved = (on * self.penalty)[..., None, None] * outer
        if turning:
            curved -= (b.face_weights * pressure / (gap + self.radius))[..., None, None] * (eye - outer)
        face = np.einsum("fpij,pa,pb->faibj", curved, b.face_values, b.face_values, optimize=True)
        parts = []
        solid = self.stiffness(self.deformation(u)).reshape(-1, 81, 81)
        for nodes, block in ((b.cells, solid), (b.faces, face.reshape(len(b.faces), 27, 27))):
            unknown = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
            row = np.repeat(unknown[:, :, None], unknown.shape[1], axis=2).reshape(-1)
            column = np.repeat(unknown[:, None, :], unknown.shape[1], axis=1).reshape(-1)
            parts.append(sparse.coo_matrix((block.reshape(-1), (row, column)), shape=(u.size, u.size)).tocsr())
        return (parts[0] + parts[1])[b.free][:, b.free].tocsc()

    def direction(self, tangent: sparse.csc_matrix, right: np.ndarray) -> np.ndarray:
        """Newton's step: by conjugate gradients on the last factor while that is quick, else by a new factor."""
        if self.factor is not None:
            guess = LinearOperator(tangent.shape, self.factor.solve)
            step, failed = cg(tangent, right, M=guess, rtol=1e-6, maxiter=30)
            if not failed and right @ step > 0.0:
                return step
        self.factor = splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                           options={"SymmetricMode": True})
        return self.factor.solve(right)

    def equilibrium(self) -> int:
        """Newton's method until the unbalanced force is 1e-6 of the supports'; the number of iterations."""
        free = self.block.free
        for iteration in range(60):
            gradient = self.unbalanced(self.u)
            left = gradient.reshape(-1)[free]
            if np.linalg.norm(left) <= 1e-6 * np.linalg.norm(gradient):
                return iteration
            step = np.zeros(self.u.size)
            step[free] = self.direction(self.tangent(self.u), -left)
            if left @ step[free] >= 0.0:
                self.factor = None
                step[free] = self.direction(self.tangent(self.u, turning=False), -left)
            slope, size = float(left @ step[free]), 1.0
            before = self.energy(self.u)
            while (self.energy(self.u + size * step.reshape(-1, 3)) > before + 1e-4 * size * slope + 1e-12 * abs(before)
                   and size > 1e-6):
                size *= 0.5  # a change of the energy below its rounding error passes
            self.u = self.u + size * step.reshape(-1, 3)
        raise RuntimeError("no equilibrium in 60 Newton iterations.")

    def to(self, depth: float) -> float:
        """Force [N] on the whole sphere (all parts of the block) at ``depth`` [m] past first contact."""
        top = self.block.points[:, 2].max() + self.radius
        strides = int(np.ceil((self.centre[2] - top + depth) / 6e-4))
        for height in np.linspace(self.centre[2], top - depth, 1 + strides)[1:]:
            last, stride = self.u, self.centre[2] - height
            guess = last + stride * self.rate
            if np.isfinite(self.energy(guess)):
                self.u = guess
            self.centre[2] = height
            self.equilibrium()
            self.rate = (self.u - last) / stride
        force = np.inf
        for _ in range(20):
            self.equilibrium()
            gap, normal, pressure = self.contact(self.u)
            last, force = force, -self.block.parts * float((self.block.face_weights * pressure * normal[..., 2]).sum())
            if (-gap * (pressure > 0.0)).max() < 1e-4 * depth or abs(force - last) < 1e-5 * force:
                break
            self.multiplier = pressure
        return force


def curve(press: Press, depths: list[float]) -> list[float]:
    """Forces [N] at increasing ``depths`` [m]."""
    print(f"{len(press.block.cells)} elements, {len(press.block.free)} unknowns", flush=True)
    out = []
    for depth in depths:
        began = time.perf_counter()
        out.append(press.to(depth))
        print(f"  {1e3 * depth:g} mm  {out[-1]:.4f} N  ({time.perf_counter() - began:.1f} s)", flush=True)
    return out


def report(cells: list[float], depths: list[float], forces: np.ndarray, data: dict[str, Any]) -> None:
    """Print ``forces`` (cells, depths) [N], their limit (second order in the cell) and the stored values of ``data``.

    Args:
        cells: at the contact, decreasing [mm]. depths: [m].
    """
    finest = forces[-1]
    if len(cells) > 1:
        finest = finest + (finest - forces[-2]) / ((cells[-2] / cells[-1]) ** 2 - 1.0)
    print(f"{'depth mm':>9}" + "".join(f"{f'{c:g} mm':>10}" for c in cells) + f"{'limit':>10}{'stored':>10}")
    for k, depth in enumerate(depths):
        known = np.interp(depth, [0.0, *data["depth_m"]], [0.0, *data["force_N"]])
        print(f"{1e3 * depth:9.3g}" + "".join(f"{f:10.4f}" for f in [*forces[:, k], finest[k]]) + f"{known:10.3f}")


def s1(cell: float, setting: dict[str, Any]) -> Press:
    """The press of S1 on cells of ``cell`` [m] at the contact; ``setting``: that of `s1.json`."""
    block = Block.quarter(tuple(setting["block_m"]), cell, even=0.015, growth=1.4, face_points=6)
    return Press(block, setting["young_modulus_Pa"], setting["poisson_ratio"], 0.02)


def main() -> None:
    """Compute S1 on each mesh, extrapolate, and compare with `s1.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", type=float, nargs="+", default=[7.5, 5.0, 3.5], help="cells at the contact [mm]")
    parser.add_argument("--depth", type=float, nargs="+", default=[2.5, 5.0], help="depths [mm]")
    given = parser.parse_args()
    data = json.loads((HERE / "s1.json").read_text())
    depths = [1e-3 * d for d in given.depth]
    forces = np.array([curve(s1(1e-3 * cell, data["setting"]), depths) for cell in given.cell])
    report(given.cell, depths, forces, data)


if __name__ == "__main__":
    main()
