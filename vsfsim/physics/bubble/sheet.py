"""A clamped sheet or a closed skin under gas pressure, by Newton's method with a sparse factor of every tangent.

    f(x) - p grad V(x) = 0       with the pressure p given, or with the volume V given and p unknown

With the volume given the method passes limit points of the pressure. The module serves the inflation of a sensor and
the closed forms; touches are solved by `Solver`.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.sparse.linalg import splu

from vsfsim.physics.elements import gas
from vsfsim.physics.elements.block import Block
from vsfsim.physics.solve.elasticity import Elasticity

_ITERATIONS = 60
_TIGHT = 1e-11  # tolerance of unbalanced over acting force: 100 times the rounding error of sums over all nodes
# tolerance where rounding prevents a further decrease, as of flat sheets at almost no pressure
_GOOD = 1e-6


@dataclasses.dataclass(frozen=True)
class Balanced:
    """An equilibrium."""

    displacement: np.ndarray
    """Displacements of the nodes (3 n,) [m]."""
    pressure: float
    """Gauge pressure [Pa]."""
    volume: float
    """Volume inside the surface [m^3]."""
    residual: float
    """Unbalanced over acting force [-]."""


class Sheet:
    """The elements of a surface, and the volume that it encloses.

    Args:
        points: positions at u = 0 (n, 3) [m].
        blocks: elastic elements.
        closed: faces of the closed surface (m, 3), a cap over the rim included.
        free: 1 for the degrees of freedom that may move, else 0 (3 n,).
    """

    def __init__(self, points: np.ndarray, blocks: tuple[Block, ...], closed: np.ndarray, free: np.ndarray):
        self.points, self.blocks, self.closed, self.free = points, blocks, closed, free
        self._moves = np.flatnonzero(free)
        model = SimpleNamespace(blocks=blocks, mesh=SimpleNamespace(points=points), free=free)
        self._elastic = Elasticity(model, device="cpu")  # type: ignore[arg-type]
        self._elastic.begin(1)
        self._index = wp.zeros(1, dtype=wp.int32, device="cpu")
        dofs = [(3 * nodes[:, :, None].astype(np.int64) + np.arange(3)).reshape(len(nodes), -1)
                for nodes in (*(b.nodes for b in blocks), closed)]
        self._rows = np.concatenate([np.repeat(d, d.shape[1], axis=1).ravel() for d in dofs])
        self._columns = np.concatenate([np.tile(d, (1, d.shape[1])).ravel() for d in dofs])

    def forces(self, u: np.ndarray) -> np.ndarray:
        """Elastic forces +dE/du (3 n,) [N] at u (3 n,) [m]."""
        self._elastic.forces(self._index, wp.array(u[:, None], dtype=wp.float64, device="cpu"))
        return self._elastic.internal.numpy()[:, 0].copy()

    def volume(self, u: np.ndarray) -> float:
        """Volume inside the surface at u (3 n,) [m^3]."""
        return gas.volume(self.points + u.reshape(-1, 3), self.closed)

    def tangent(self, u: np.ndarray, pressure: float) -> sp.csr_matrix:
        """Derivative of f - p grad V by the displacements, without supports (3 n, 3 n) [N/m]."""
        air = -pressure * gas.hessian(gas.corners(self.points + u.reshape(-1, 3), self.closed))
        values = np.concatenate([part.ravel() for part in (*(block.matrices(u) for block in self.blocks), air)])
        return sp.coo_matrix((values, (self._rows, self._columns)), shape=(len(u), len(u))).tocsr()

    def _state(self, u: np.ndarray, pressure: float) -> tuple[np.ndarray, np.ndarray, float]:
        """Residual of the free degrees of freedom, grad V there, and unbalanced over acting force."""
        gradient = gas.gradient(self.points + u.reshape(-1, 3), self.closed)
        forces = self.forces(u)
        residual = (pressure * gradient - forces)[self._moves]
        acting = np.abs(pressure * gradient[self._moves]).sum() + 1e-9 * np.abs(forces[self._moves]).sum() + 1e-300
        return residual, gradient[self._moves], float(np.abs(residual).sum() / acting)

    def at_volume(self, u: np.ndarray, pressure: float, volume: float, *,
                  iterations: int = _ITERATIONS) -> Balanced | None:
        """The equilibrium with this volume [m^3] from the guess u (3 n,) [m] and pressure [Pa], or None if Newton's
        method does not converge."""
        return self._newton(u, pressure, volume, iterations)

    def at_pressure(self, u: np.ndarray, pressure: float, *, iterations: int = _ITERATIONS) -> Balanced | None:
        """The equilibrium at this gauge pressure [Pa] from the guess u (3 n,) [m], or None if Newton's method does not
        converge."""
        return self._newton(u, pressure, None, iterations)

    def _newton(self, u: np.ndarray, pressure: float, volume: float | None, iterations: int) -> Balanced | None:
        """With ``volume`` None the pressure stays as it is; otherwise it is an unknown."""
        def missing_volume(at: np.ndarray) -> float:
            return 0.0 if volume is None else 1.0 - self.volume(at) / volume

        u = u.copy()
        short = missing_volume(u)
        residual, gradient, error = self._state(u, pressure)
        for _ in range(iterations):
            if error < _TIGHT and abs(short) < 1e-12:
                break
            whole, right = self.tangent(u, pressure)[self._moves][:, self._moves].tocsc(), residual
            if volume is not None:
                whole = sp.bmat([[whole, -gradient[:, None]], [-gradient[None], None]], format="csc")
                right = np.append(residual, -short * volume)
            try:
                step = splu(whole, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": volume is None}).solve(right)
            except RuntimeError:  # exactly singular
                return None
            if not np.isfinite(step).all():
                return None
            rise = 0.0 if volume is None else float(step[-1])
            # one scale for the whole step, as the acting force changes with the pressure
            acting = max(abs(pressure), abs(pressure + rise)) * np.abs(gradient).sum() + 1e-300
            missing = np.abs(residual).sum() / acting + abs(short)
            for share in 0.5 ** np.arange(10):
                trial = u.copy()
                trial[self._moves] += share * step[:len(self._moves)]
                new, now = self._state(trial, pressure + share * rise), missing_volume(trial)
                if np.isfinite(new[2]) and np.abs(new[0]).sum() / acting + abs(now) < (1.0 - 0.1 * share) * missing:
                    break
            else:
                if missing < _GOOD:
                    break  # no further decrease because of rounding
                if volume is None:
                    return None
            u, pressure, short = trial, pressure + share * rise, now
            residual, gradient, error = new
        if not (error < _GOOD and abs(short) < 1e-9):
            return None
        return Balanced(u, float(pressure), self.volume(u), error)
