"""A clamped sheet or a closed skin under gas pressure, by Newton's method with a sparse factor of every tangent.

    f(x) - p grad V(x) = 0       with the pressure p given, or with the volume V given and p unknown

With the volume given the method passes limit points of the pressure. A rubber membrane has a largest pressure: beyond
its *limit point* a larger volume needs less pressure, and under a prescribed pressure the membrane would grow without
bound. The working state of a sensor is on the branch from the flat state, before that point: `inflate` follows it by
continuation in the volume. The module serves that and the closed forms; touches are solved by `Solver`.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import warp as wp
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from vsfsim.core.errors import SceneError
from vsfsim.physics.elements import gas
from vsfsim.physics.elements.block import Block
from vsfsim.physics.solve.elasticity import Elasticity

_ITERATIONS = 60
_TIGHT = 1e-11  # tolerance of unbalanced over acting force: 100 times the rounding error of sums over all nodes
# tolerance where rounding prevents a further decrease, as of flat sheets at almost no pressure
_GOOD = 1e-6
_GROWTH, _MOST_TIMES = 1.4, 1e4  # ratio of the volumes of two steps, and of the last and the first one
_LEAST = 1e-3  # smallest growth of the volume in a step


@dataclasses.dataclass(frozen=True)
class Balanced:
    """An equilibrium."""

    displacement: np.ndarray
    """Displacements of the nodes (3 n,) [m]."""
    pressure: float
    """Gauge pressure [Pa]."""
    volume: float
    """Volume inside the surface [m^3]."""


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

    def balanced(self, u: np.ndarray, pressure: float, volume: float | None = None, *,
                 iterations: int = _ITERATIONS) -> Balanced | None:
        """The equilibrium at a gauge pressure [Pa], or with a volume [m^3], to which the pressure is a guess, from the
        guess u (3 n,) [m]; None if Newton's method does not converge."""
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
        return Balanced(u, float(pressure), self.volume(u))


def inflate(sheet: Sheet, guess: np.ndarray, pressure: float, *, where: str) -> Balanced:
    """The equilibrium at a gauge pressure, on the branch from the flat state.

    Args:
        sheet: the sheet, flat and clamped at u = 0.
        guess: a shallow dome (3 n,) [m].
        pressure: gauge pressure [Pa].
        where: scene and section, for messages.

    Raises:
        SceneError: the pressure is beyond the limit point, or the branch could not be followed.
    """
    first = _shallow(sheet, guess, pressure, where)
    states, growth, limited = [first], _GROWTH, False
    while (states[-1].pressure < pressure and growth > 1.0 + _LEAST and states[-1].volume < _MOST_TIMES * first.volume):
        volume = growth * states[-1].volume
        found = sheet.balanced(*_ahead(states[-2:], volume), volume)
        limited = found is not None and found.pressure < states[-1].pressure
        if found is None or limited:
            growth = 1.0 + 0.5 * (growth - 1.0)
            continue
        growth = min(_GROWTH, 1.0 + 1.5 * (growth - 1.0))
        states.append(found)
    last = states[-1]
    if last.pressure < pressure:
        reach, why = ("'s limit point is at", ": beyond it a rubber membrane blows up without bound") if limited else (
            " could be followed only to", "")
        raise SceneError(f"{where}: gauge_pressure is {pressure:g} Pa, but the membrane{reach} {last.pressure:.5g} Pa "
                         f"(volume {1e6 * last.volume:.4g} mL, height "
                         f"{1e3 * float(np.abs(last.displacement).max()):.3g} mm){why}. Give less pressure, or a "
                         f"larger young_modulus or thickness.")
    return last if len(states) == 1 else _between(sheet, states[-2:], pressure, where)


def _shallow(sheet: Sheet, guess: np.ndarray, pressure: float, where: str) -> Balanced:
    """A state below the pressure, near the plane: there the pressure grows with the volume or faster."""
    volume = sheet.volume(guess)
    for _ in range(60):
        found = sheet.balanced(guess, pressure, volume)
        if found is not None and found.pressure <= pressure:
            return found
        share = 0.5 if found is None else max(0.05, min(0.7, pressure / found.pressure))
        volume, guess = share * volume, share * (guess if found is None else found.displacement)
    raise SceneError(f"{where}: the membrane could not be inflated from flat to a gauge pressure of {pressure:g} Pa; "
                     f"check young_modulus, thickness and pre_stretch.")


def _ahead(states: list[Balanced], volume: float) -> tuple[np.ndarray, float]:
    """Displacement and pressure at a volume, by the line through two states, or in proportion to one."""
    now = states[-1]
    if len(states) == 1:
        return now.displacement * volume / now.volume, now.pressure * volume / now.volume
    before = states[0]
    share = (volume - now.volume) / (now.volume - before.volume)
    return (now.displacement + share * (now.displacement - before.displacement),
            now.pressure + share * (now.pressure - before.pressure))


def _between(sheet: Sheet, ends: list[Balanced], pressure: float, where: str) -> Balanced:
    """The state at the pressure, which is between those of two states of the rising branch."""
    def found(volume: float) -> Balanced:
        state = sheet.balanced(*_ahead(ends, volume), volume)
        if state is None:
            raise SceneError(f"{where}: the membrane could not be brought to a gauge pressure of {pressure:g} Pa; "
                             f"check young_modulus, thickness and pre_stretch.")
        return state

    low, high = ends
    near = found(brentq(lambda volume: found(volume).pressure - pressure, low.volume, high.volume, rtol=1e-6))
    return sheet.balanced(near.displacement, pressure) or near
