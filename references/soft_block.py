"""Sphere pressed into a soft block: an independent computation of S1 (`s1.json`).

    python references/soft_block.py                  # three meshes (20 minutes of a core), Richardson extrapolation
    python references/soft_block.py --cell 5 --depth 2.5 5

One quarter of the block, 27-node hexahedra with 27 Gauss points, total Lagrangian, the compressible neo-Hookean law
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

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg, splu

HERE = Path(__file__).parent


def ticks(cell: float, even: float, length: float, growth: float) -> np.ndarray:
    """Grid lines (n,) [m] from 0 to ``length``: cells of ``cell`` up to ``even``, then growing by ``growth``."""
    steps = [cell] * max(1, round(even / cell))
    while sum(steps) < length - 1e-12:
        steps.append(min(steps[-1] * growth, length / 4.0))
    return np.concatenate([[0.0], np.cumsum(steps)]) * length / sum(steps)


def lagrange(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic shape functions of the nodes -1, 0, 1 at ``at`` (q,) and their derivatives (q, 3), (q, 3)."""
    return (np.stack([0.5 * at * (at - 1.0), 1.0 - at**2, 0.5 * at * (at + 1.0)], axis=1),
            np.stack([at - 0.5, -2.0 * at, at + 0.5], axis=1))


@dataclass
class Block:
    """A quarter of the block on a graded mesh of 27-node hexahedra."""

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

    @classmethod
    def of(cls, size: tuple[float, float, float], cell: float, even: float, growth: float, face_points: int) -> Block:
        """A quarter of a block of ``size`` [m] with cells of ``cell`` [m] within ``even`` [m] of the contact."""
        x, y = (ticks(cell, even, 0.5 * length, growth) for length in size[:2])
        z = size[2] - ticks(cell, even, size[2], growth)[::-1]
        lines = [np.sort(np.concatenate([t, 0.5 * (t[1:] + t[:-1])])) for t in (x, y, z)]
        shape = tuple(len(line) for line in lines)
        points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        number = np.arange(len(points)).reshape(shape)
        first = np.stack(np.meshgrid(*(np.arange(0, n - 1, 2) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
        offset = np.stack(np.meshgrid(*[np.arange(3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        cells = number[tuple((first[:, None] + offset[None]).transpose(2, 0, 1))]
        edge = points[cells[:, -1]] - points[cells[:, 0]]
        gauss, weight = np.polynomial.legendre.leggauss(3)
        n, d = lagrange(gauss)
        reference = np.stack([np.einsum("ai,bj,ck->abcijk", *(d if axis == k else n for k in range(3)))
                              for axis in range(3)], axis=-1).reshape(27, 27, 3)
        gradients = reference[None] * (2.0 / edge)[:, None, None, :]
        volume = np.einsum("a,b,c->abc", weight, weight, weight).reshape(-1) / 8.0
        top = np.flatnonzero(first[:, 2] == shape[2] - 3)
        gauss, weight = np.polynomial.legendre.leggauss(face_points)
        n, _ = lagrange(gauss)
        face_values = np.einsum("ai,bj->abij", n, n).reshape(face_points**2, 9)
        area = np.outer(weight, weight).reshape(-1) / 4.0
        held = np.zeros(points.shape, bool)
        held[points[:, 2] < 1e-12] = True
        held[points[:, 0] < 1e-12, 0] = True
        held[points[:, 1] < 1e-12, 1] = True
        return cls(points, cells, gradients, edge.prod(axis=1)[:, None] * volume, cells[top][:, 2::3], face_values,
                   edge[top, :2].prod(axis=1)[:, None] * area, np.flatnonzero(~held.reshape(-1)))


class Press:
    """The quarter block under the sphere: forces, tangent and the Newton iteration.

    Args:
        block: the mesh. young_modulus: [Pa]. poisson_ratio: [-]. radius: of the sphere [m].
        penalty: pressure over penetration [Pa/m].
    """

    def __init__(self, block: Block, young_modulus: float, poisson_ratio: float, radius: float, penalty: float = 1e10):
        self.block, self.radius, self.penalty = block, radius, penalty
        self.mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
        self.lam = young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
        self.u = np.zeros(block.points.shape)
        self.centre = np.array([0.0, 0.0, block.points[:, 2].max() + radius])
        self.multiplier = np.zeros(block.face_weights.shape)
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

    def energy(self, u: np.ndarray) -> float:
        """Elastic energy and the augmented Lagrangian of the contact [J]; infinite where an element is inverted."""
        f = self.deformation(u)
        j = np.linalg.det(f)
        if j.min() <= 0.0:
            return np.inf
        log = np.log(j)
        density = 0.5 * self.mu * ((f**2).sum(axis=(2, 3)) - 3.0) - self.mu * log + 0.5 * self.lam * log**2
        pressure = self.contact(u)[2]
        return float((self.block.weights * density).sum()
                     + (self.block.face_weights * pressure**2).sum() / (2.0 * self.penalty))

    def unbalanced(self, u: np.ndarray) -> np.ndarray:
        """Gradient of the energy (n, 3) [N]."""
        f = self.deformation(u)
        inverse = np.swapaxes(np.linalg.inv(f), 2, 3)
        log = np.log(np.linalg.det(f))[..., None, None]
        stress = self.mu * f + (self.lam * log - self.mu) * inverse
        out = np.zeros_like(u)
        np.add.at(out, self.block.cells, np.einsum("mq,mqij,mqaj->mai", self.block.weights, stress,
                                                   self.block.gradients, optimize=True))
        _, normal, pressure = self.contact(u)
        load = np.einsum("fp,fpi,pa->fai", self.block.face_weights * pressure, normal, self.block.face_values)
        np.add.at(out, self.block.faces, -load)
        return out

    def tangent(self, u: np.ndarray, turning: bool = True) -> sparse.csc_matrix:
        """Second derivative on the free unknowns (k, k) [N/m]; without ``turning`` the negative part of the contact's,
        which comes from the turning normal, is left out."""
        b, f = self.block, self.deformation(u)
        inverse = np.swapaxes(np.linalg.inv(f), 2, 3)
        log = np.log(np.linalg.det(f))
        m, eye = len(b.cells), np.eye(3)
        whole = np.zeros((m, 81, 81))
        for q in range(27):
            h = inverse[:, q]
            moduli = (self.mu * np.einsum("ik,jl->ijkl", eye, eye)[None]
                      + self.lam * np.einsum("mij,mkl->mijkl", h, h)
                      + (self.mu - self.lam * log[:, q])[:, None, None, None, None]
                      * np.einsum("mil,mkj->mijkl", h, h))
            strain = np.einsum("maj,ik->mijak", b.gradients[:, q], eye).reshape(m, 9, 81)
            whole += np.swapaxes(strain, 1, 2) @ (b.weights[:, q, None, None] * moduli.reshape(m, 9, 9) @ strain)
        gap, normal, pressure = self.contact(u)
        on = b.face_weights * (pressure > 0.0)
        outer = normal[..., :, None] * normal[..., None, :]
        curved = (on * self.penalty)[..., None, None] * outer
        if turning:
            curved -= (b.face_weights * pressure / (gap + self.radius))[..., None, None] * (eye - outer)
        face = np.einsum("fpij,pa,pb->faibj", curved, b.face_values, b.face_values, optimize=True)
        parts = []
        for nodes, block in ((b.cells, whole), (b.faces, face.reshape(len(b.faces), 27, 27))):
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
        """Force [N] on the whole sphere (all four quarters) at ``depth`` [m] past first contact."""
        top = self.block.points[:, 2].max() + self.radius
        strides = int(np.ceil((self.centre[2] - top + depth) / 6e-4))
        for height in np.linspace(self.centre[2], top - depth, 1 + strides)[1:-1]:
            self.centre[2] = height
            self.equilibrium()
        self.centre[2] = top - depth
        for _ in range(20):
            self.equilibrium()
            gap, _, pressure = self.contact(self.u)
            if (-gap * (pressure > 0.0)).max() < 1e-4 * depth:
                break
            self.multiplier = pressure
        _, normal, pressure = self.contact(self.u)
        return -4.0 * float((self.block.face_weights * pressure * normal[..., 2]).sum())


def curve(cell: float, depths: list[float], *, size: tuple[float, float, float], young_modulus: float,
          poisson_ratio: float, radius: float, even: float, growth: float = 1.4, face_points: int = 6) -> list[float]:
    """Forces [N] at increasing ``depths`` [m] on a mesh with cells of ``cell`` [m] at the contact."""
    press = Press(Block.of(size, cell, even, growth, face_points), young_modulus, poisson_ratio, radius)
    print(f"cells of {1e3 * cell:g} mm: {len(press.block.cells)} elements, {len(press.block.free)} unknowns",
          flush=True)
    out = []
    for depth in depths:
        began = time.perf_counter()
        out.append(press.to(depth))
        print(f"  {1e3 * depth:g} mm  {out[-1]:.4f} N  ({time.perf_counter() - began:.1f} s)", flush=True)
    return out


def main() -> None:
    """Compute S1 on each mesh, extrapolate, and compare with `s1.json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cell", type=float, nargs="+", default=[7.5, 5.0, 3.5], help="cells at the contact [mm]")
    parser.add_argument("--depth", type=float, nargs="+", default=[2.5, 5.0], help="depths [mm]")
    given = parser.parse_args()
    data = json.loads((HERE / "s1.json").read_text())
    setting = data["setting"]
    depths = [1e-3 * d for d in given.depth]
    forces = np.array([curve(1e-3 * cell, depths, size=tuple(setting["block_m"]),
                             young_modulus=setting["young_modulus_Pa"], poisson_ratio=setting["poisson_ratio"],
                             radius=0.02, even=0.015) for cell in given.cell])
    finest = forces[-1]
    if len(given.cell) > 1:  # second order in the cell
        finest = finest + (finest - forces[-2]) / ((given.cell[-2] / given.cell[-1]) ** 2 - 1.0)
    print(f"{'depth mm':>9}" + "".join(f"{f'{c:g} mm':>10}" for c in given.cell) + f"{'limit':>10}{'s1.json':>10}")
    for k, depth in enumerate(depths):
        known = np.interp(depth, [0.0, *data["depth_m"]], [0.0, *data["force_N"]])
        print(f"{1e3 * depth:9.3g}" + "".join(f"{f:10.4f}" for f in [*forces[:, k], finest[k]])
              + f"{known:10.3f}")


if __name__ == "__main__":
    main()
