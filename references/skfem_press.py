"""A rigid frictionless probe pressed into an elastic body by scikit-fem; nothing of `vsfsim` is used.

Any element and mesh of scikit-fem, in space or in the half plane (r, z) of what is round about the z axis. A penalty at
the quadrature points of the surface keeps it out of the probe. Newton's method with SuperLU and a line search on the
energy, total Lagrangian, on the neo-Hookean law W = mu/2 (I_c - 3) - mu ln J + lambda/2 (J - 1)^2, that of
`docs/physics.md`, or on that of `hyperfoam.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import skfem
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import LinearOperator, cg, splu

from references import hyperfoam

STIFF = 300.0
"""Penalty over E / edge [-]."""
MOST = 25
"""Newton iterations of a step."""


class NeoHooke:
    """W = mu/2 (I_c - 3) - mu ln J + lambda/2 (J - 1)^2 of moduli ``young`` (m, 1) [Pa]."""

    def __init__(self, young: np.ndarray, nu: float):
        self.mu = young / (2.0 * (1.0 + nu))
        self.lam = 2.0 * self.mu * nu / (1.0 - 2.0 * nu)

    def energy(self, f: np.ndarray) -> np.ndarray:
        """(m, q) [Pa] of deformation gradients (m, q, 3, 3)."""
        j = np.linalg.det(f)
        return 0.5 * self.mu * ((f**2).sum(axis=(2, 3)) - 3.0) - self.mu * np.log(j) + 0.5 * self.lam * (j - 1.0) ** 2

    def stress(self, f: np.ndarray) -> np.ndarray:
        """(m, q, 3, 3) [Pa]."""
        j, across = np.linalg.det(f), np.swapaxes(np.linalg.inv(f), 2, 3)
        return self.mu[..., None, None] * f + (self.lam * (j - 1.0) * j - self.mu)[..., None, None] * across

    def moduli(self, f: np.ndarray) -> np.ndarray:
        """(m, q, 3, 3, 3, 3) [Pa]."""
        j, across = np.linalg.det(f), np.swapaxes(np.linalg.inv(f), 2, 3)
        wide, eye = (..., None, None, None, None), np.eye(3)
        return (self.mu[wide] * np.einsum("ik,jl->ijkl", eye, eye)
                + (self.lam * (2.0 * j - 1.0) * j)[wide] * across[..., None, None] * across[..., None, None, :, :]
                + (self.mu - self.lam * (j - 1.0) * j)[wide] * np.einsum("mqil,mqkj->mqijkl", across, across))


class Foam:
    """The law of `hyperfoam.py` with rows (k, 3) of mu [Pa], alpha and beta."""

    def __init__(self, rows: Any):
        self.rows = np.asarray(rows)

    def __getattr__(self, name: str) -> Callable[[np.ndarray], np.ndarray]:
        return lambda f: getattr(hyperfoam, name)(f, self.rows)


class Press:
    """A body under a rigid probe.

    Args:
        basis: of displacements, in (r, z) or (x, y, z).
        face: basis of the part of the surface that may touch.
        law: with `energy`, `stress` and `moduli`.
        held: unknowns that do not move.
        gap: gap of points (d, ...) from the probe's origin at rest: distance [m], its gradient (d, ...), and its second
            derivative (d, d, ...) [1/m].
        penalty: pressure over overlap [Pa/m].
        parts: such parts that make the whole body.
        tolerance: unbalanced force over the contact force at which Newton's method ends [-].
    """

    stride = 0.5
    """Part of the way between two origins that is tried first [-]."""

    def __init__(self, basis: skfem.Basis, face: skfem.FacetBasis, law: Any, held: np.ndarray,
                 gap: Callable[..., Any], *, penalty: float, parts: float = 1.0,
                 tolerance: float = 1e-6):
        self.basis, self.law, self.gap, self.penalty, self.parts = basis, law, gap, penalty, parts
        self.tolerance = tolerance
        d, (m, q) = basis.mesh.dim(), basis.dx.shape
        self.u, self.free = basis.zeros(), np.setdiff1d(np.arange(basis.N), held)
        self.rate = basis.zeros()  # of u over the last step's way [-]
        self.dofs, self.factor = basis.element_dofs.T, None
        self.shapes = np.zeros((m, q, 9, len(basis.basis)))
        for k, (one,) in enumerate(basis.basis):
            grad = np.broadcast_to(np.asarray(one.grad), (d, d, m, q))
            for (i, row), (j, column) in ((a, b) for a in self._axes(d) for b in self._axes(d)):
                self.shapes[..., 3 * row + column, k] = grad[i, j]
            if d == 2:  # round about the axis
                self.shapes[..., 4, k] = np.broadcast_to(np.asarray(one), (d, m, q))[0] / self._places(basis)[0]
        around = [2.0 * np.pi * self._places(b)[0] if d == 2 else 1.0 for b in (basis, face)]
        self.dx = basis.dx * around[0]
        self.area, self.at = face.dx * around[1], self._places(face)
        self.values = np.stack([np.broadcast_to(np.asarray(one), (d, *face.dx.shape)) for (one,) in face.basis],
                               axis=-1).transpose(1, 2, 0, 3)  # (f, p, d, n)
        self.touching = face.element_dofs.T
        n, number = len(self.free), np.full(basis.N, -1)
        number[self.free] = np.arange(n)
        own = [number[part] for part in (self.dofs, self.touching)]
        down = np.concatenate([np.repeat(part, part.shape[1], axis=1).ravel() for part in own])
        along = np.concatenate([np.tile(part, part.shape[1]).ravel() for part in own])
        self.inside = (down >= 0) & (along >= 0)
        place, self.to = np.unique((along * n + down)[self.inside], return_inverse=True)
        self.rows, self.starts = place % n, np.searchsorted(place, n * np.arange(n + 1))

    @staticmethod
    def _places(basis: Any) -> np.ndarray:
        """Quadrature points (d, ...) [m]."""
        return np.asarray(basis.default_parameters()["x"])

    @staticmethod
    def _axes(d: int) -> list[tuple[int, int]]:
        return [(0, 0), (1, 2)] if d == 2 else [(0, 0), (1, 1), (2, 2)]

    def deformation(self, u: np.ndarray) -> np.ndarray:
        """(m, q, 3, 3) [-]."""
        return np.eye(3) + (self.shapes @ u[self.dofs][:, None, :, None])[..., 0].reshape(*self.dx.shape, 3, 3)

    def contact(self, u: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, ...]:
        """See ``gap``, of the surface's points."""
        moved = self.at + np.einsum("fpdn,fn->dfp", self.values, u[self.touching])
        return self.gap(moved - origin.reshape(-1, 1, 1))

    def energy(self, u: np.ndarray, origin: np.ndarray) -> float:
        """[J]; infinite where an element is inverted."""
        f = self.deformation(u)
        if np.linalg.det(f).min() <= 0.0:
            return np.inf
        overlap = np.minimum(self.contact(u, origin)[0], 0.0)
        return float((self.dx * self.law.energy(f)).sum() + 0.5 * self.penalty * (self.area * overlap**2).sum())

    def forces(self, u: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of the elements, and of the probe, on every unknown [N]."""
        stress = self.law.stress(self.deformation(u)).reshape(*self.dx.shape, 9)
        own = ((self.dx[..., None] * stress)[..., None, :] @ self.shapes).sum(axis=(1, 2))
        distance, normal, _ = self.contact(u, origin)
        push = np.einsum("fp,dfp,fpdn->fn", self.penalty * self.area * np.minimum(distance, 0.0), normal, self.values)
        return (np.bincount(self.dofs.ravel(), own.ravel(), self.basis.N),
                np.bincount(self.touching.ravel(), push.ravel(), self.basis.N))

    def tangent(self, u: np.ndarray, origin: np.ndarray, *, turning: bool = True) -> csc_matrix:
        """Second derivative on the free unknowns; without ``turning`` without that of the gap."""
        m, n = self.dofs.shape
        moduli = self.law.moduli(self.deformation(u)).reshape(*self.dx.shape, 9, 9)
        half = (self.dx[..., None, None] * moduli @ self.shapes).reshape(m, -1, n)
        solid = np.swapaxes(self.shapes.reshape(m, -1, n), 1, 2) @ half
        distance, normal, bend = self.contact(u, origin)
        on = self.penalty * self.area * (distance < 0.0)
        block = on * (normal[:, None] * normal[None] + (distance * bend if turning else 0.0))
        face = np.einsum("defp,fpdn,fpek->fnk", block, self.values, self.values, optimize=True)
        data = np.bincount(self.to, np.concatenate([solid.ravel(), face.ravel()])[self.inside], len(self.rows))
        return csc_matrix((data, self.rows, self.starts), (len(self.free), len(self.free)))

    def direction(self, tangent: csc_matrix, right: np.ndarray) -> np.ndarray:
        """By conjugate gradients on the last factor while that is quick, else by a new factor."""
        if self.factor is not None:
            step, failed = cg(tangent, right, M=LinearOperator(tangent.shape, self.factor.solve), rtol=1e-5, maxiter=20)
            if not failed and right @ step > 0.0:
                return step
        self.factor = splu(tangent, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
        return self.factor.solve(right)

    def settle(self, u: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, float] | None:
        """The equilibrium from ``u`` and what is unbalanced of its force [-]; None without one."""
        for _ in range(MOST):
            own, push = self.forces(u, origin)
            rest = (own + push)[self.free]
            left = float(np.abs(rest).sum() / max(np.abs(push).sum(), 1e-9))
            if left < self.tolerance:
                return u, left
            step = np.zeros_like(u)
            step[self.free] = self.direction(self.tangent(u, origin), -rest)
            if rest @ step[self.free] >= 0.0:
                self.factor = None
                step[self.free] = self.direction(self.tangent(u, origin, turning=False), -rest)
                if rest @ step[self.free] >= 0.0:
                    return None
            now, slope, size = self.energy(u, origin), float(rest @ step[self.free]), 1.0
            while not self.energy(u + size * step, origin) <= now + 1e-4 * size * slope + 1e-12 * abs(now):
                size *= 0.5  # a change below the rounding of the energy passes
                if size < 1e-4:
                    return None
            u = u + size * step
        return None

    def lift(self, origin: np.ndarray) -> float:
        """Force along the last axis on the whole body's probe [N]."""
        distance, normal, _ = self.contact(self.u, origin)
        return self.parts * float((self.penalty * self.area * np.minimum(distance, 0.0) * normal[-1]).sum())

    def curve(self, origins: np.ndarray) -> list[float]:
        """Forces [N] with the probe's origin at each of ``origins`` (t, d) [m], after one that does not touch."""
        found, here = [], origins[0]
        for aim in origins[1:]:
            whole = np.linalg.norm(aim - here)
            done, part = 0.0, self.stride
            start = here
            while done < 1.0:
                stride = min(part, 1.0 - done)
                there = start + (done + stride) * (aim - start)
                guess = self.u + stride * whole * self.rate
                made = next((one for first in ([guess] if np.isfinite(self.energy(guess, there)) else []) + [self.u]
                             if (one := self.settle(first, there)) is not None), None)
                if made is None:
                    part = 0.5 * stride
                    if part < 1e-3:
                        raise RuntimeError(f"no equilibrium at {there}")
                    continue
                self.rate, self.u, done = (made[0] - self.u) / (stride * whole), made[0], done + stride
            here = aim
            found.append(self.lift(aim))
        return found


def gap_of(probe: tuple[Any, ...]) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The ``gap`` of a `Press` by a probe of `references/cells.py`, whose origin is its lowest point."""
    kind, *sizes = probe

    def ball(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        away = x.copy()
        away[-1] -= sizes[0]
        eye = np.eye(len(x))
        if kind == "capsule":
            along = np.clip(away[1], -0.5 * sizes[1], 0.5 * sizes[1])
            inner = np.abs(away[1]) < 0.5 * sizes[1]
            away[1] -= along
        far = np.linalg.norm(away, axis=0)
        normal = away / far
        bend = eye[:, :, None, None] - normal[:, None] * normal[None]
        if kind == "capsule":
            bend[1, 1] = np.where(inner, 0.0, bend[1, 1])
        return far - sizes[0], normal, bend / far

    def corner(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        wide = [] if kind == "plane" else [sizes[0]] if kind == "cylinder" else [0.5 * v for v in sizes]
        sides = np.stack([np.abs(x[k]) - w for k, w in enumerate(wide)] + [-x[-1]])
        most, axis = sides.max(axis=0), sides.argmax(axis=0)
        axis = np.where(axis == len(wide), len(x) - 1, axis)
        normal = np.where(np.arange(len(x)).reshape(-1, 1, 1) == axis, np.sign(x), 0.0)
        normal[-1] = np.where(axis == len(x) - 1, -1.0, 0.0)
        return most, normal, np.zeros((len(x), len(x), 1, 1))

    return ball if kind in ("sphere", "capsule") else corner
