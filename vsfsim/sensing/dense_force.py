"""Contact forces on the nodes of an air-filled bubble from their noisy displacements and the pressure: what a real
Punyo's user computes.

Neural VSF, section III-A, says this much: the contact forces are what is left of the equilibrium of air and skin; the
air's force is "the internal pressure reading multiplied by the triangle area"; "a calibrated linear FEM model" gives
the skin's, f_elastic = K u; and "a Quadratic Programming (QP) formulation is used to regularize the estimated forces".
It gives no objective, no constraint and no weight. They are in its reference [31] (Peng, Yao and Hauser, ICRA 2024) and
that paper's public code: K is plane stress about the inflated dome without tension, E h 737.1 N/m, nu 0.5;
the air's force is the pressure *change* times the measured area; the rim is held; and

    min_u  sum_i k_disp |u_i - d_i|^2  +  k_force sum_i |f_i|      (or k_force sum_i |f_i|^2: the quadratic program),
    f = K u - dp a(x)

with d the tracked displacements: no inward push, no cone of friction. Methods here:

    residual   f = K d - dp a, nothing more
    paper      the quadratic program (squared forces)
    released   the default of the public code (sum of norms, which makes most nodes exactly free), its weights
    taut       ours, for a bubble of which no more is known than for `paper`: K also holds the skin's tension (a soap
    film's under the calibrated
               pressure) and the turning of the full pressure with the skin; sum of norms, neighbours alike, forces in a
               cone of friction about the inward normal
    membrane   ours, where the stress-free shape is known: neo-Hookean skin at the measured shape, then as `taut`;
    linearised anew about its own answer

`vsfsim measure dense-force` compares all five with the simulator's true contact forces.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from vsfsim.core.errors import did_you_mean
from vsfsim.sensing.force_program import ForceProgram, solve
from vsfsim.sensing.membrane_fe import (
    NeoHookeanMembrane,
    SensorError,
    checked_mesh,
    nodal_areas,
    nodal_normals,
    plane_stress_stiffness,
    pressure_stiffness,
    tension_stiffness,
    uniform_tension,
)

METHODS = ("residual", "paper", "released", "taut", "membrane")

RELEASED_FORCE, RELEASED_DISPLACEMENT, RELEASED_STIFFNESS = 0.34601, 534094.0, 737.1
"""k_force [1/N], k_disp [1/m^2] and E h [N/m] of the public code of [31]; it divides k_disp by (nodes / rim
nodes)^2."""


@dataclass(frozen=True)
class BubbleCalibration:
    """What the owner of a bubble knows about it.

    rest: read-out nodes of the free dome, mount frame (n, 3) [m]. triangles: wound outwards (m, 3). rim: True where the
    skin is clamped (n,).
    stiffness: E h of the skin [N/m]. pressure: gauge pressure of the free dome [Pa]. poisson_ratio: of the linear model
    [-].
    reference: stress-free material coordinates (n, 2) [m], None if unknown; `membrane` needs them. shear: mu h there
    [N/m], one number or (m,);
    None for E h / 3.
    """

    rest: np.ndarray
    triangles: np.ndarray
    rim: np.ndarray
    stiffness: float
    pressure: float
    poisson_ratio: float = 0.5
    reference: np.ndarray | None = None
    shear: float | np.ndarray | None = None


@dataclass(frozen=True)
class EstimatorOptions:
    """Weights of an estimate.

    displacement_std: noise of a node's displacement, per component [m]. model_std: what a linear model adds to it in a
    large press, as a displacement [m]; `taut` only. force_scale: size of a node's force that is worth explaining [N];
    the lasso's weight is 1 / force_scale and the ridge's 1 / force_scale^2. neighbour_scale: how far the forces of
    neighbouring nodes in contact differ [N], `taut` and `membrane` only; infinity for any. friction: of the cone,
    `taut` and `membrane` only [-]. rounds: linearisations, `membrane` only.
    tolerance: of the program's optimality conditions [-]. iterations: of the program, at most.
    """

    displacement_std: float = 5e-5
    model_std: float = 5e-4
    force_scale: float = 0.05
    neighbour_scale: float = 0.2
    friction: float = 1.0
    rounds: int = 2
    tolerance: float = 1e-4
    iterations: int = 4000

    def __post_init__(self) -> None:
        for name in ("displacement_std", "model_std", "force_scale", "neighbour_scale", "friction", "tolerance"):
            value = getattr(self, name)
            if not 0.0 < value or (name not in ("friction", "neighbour_scale") and not np.isfinite(value)):
                raise SensorError(f"dense force: {name} is {value!r}; it must be greater than 0.")
        if self.rounds < 1 or self.iterations < 1:
            raise SensorError(f"dense force: rounds {self.rounds} and iterations {self.iterations}; give at least 1.")


@dataclass(frozen=True)
class DenseForce:
    """The estimate of T frames.

    force: of the object on each node, mount frame (T, n, 3) [N]; 0 on the rim. position: the shape that goes with it
    (T, n, 3) [m].
    residual: of the program's optimality conditions (T,) [-], 0 for `residual`. converged: it is under 1e-3 (T,).
    """

    force: np.ndarray
    position: np.ndarray
    residual: np.ndarray
    converged: np.ndarray


def inner_edges(triangles: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Edges (e, 2) between nodes that are free, numbered among the free ones alone; triangles (m, 3), rim (n,) bool."""
    pairs = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return (np.cumsum(~rim) - 1)[pairs[~rim[pairs].any(axis=1)]]


class DenseForceEstimator:
    """Forces on the nodes of one bubble.

    Args:
        calibration: of the bubble. method: one of `METHODS`. options: weights; `released` takes its own, and its own
        stiffness, and only tolerance and iterations from here.

    Raises:
        SensorError: unknown method, a calibration that does not fit, or `membrane` without stress-free coordinates.
    """

    def __init__(self, calibration: BubbleCalibration, *, method: str = "paper",
                 options: EstimatorOptions | None = None):
        if method not in METHODS:
            raise SensorError(f"dense force: unknown method '{method}'. {did_you_mean(method, METHODS)}")
        self.rest, self.triangles = checked_mesh(calibration.rest, calibration.triangles, "dense force")
        rim = np.asarray(calibration.rim, bool)
        if rim.shape != (len(self.rest),) or rim.all() or not rim.any():
            raise SensorError(f"dense force: rim has shape {rim.shape}; give one bool a node, ({len(self.rest)},), "
                              f"some held and some free.")
        for name in ("stiffness", "pressure"):
            value = getattr(calibration, name)
            if not 0.0 < value < np.inf:
                raise SensorError(f"dense force: {name} is {value!r}; it must be greater than 0.")
        self.method, self.calibration, self.options = method, calibration, options or EstimatorOptions()
        self.inner = np.flatnonzero(~rim)
        self.free = (3 * self.inner[:, None] + np.arange(3)).ravel()
        self._edges = inner_edges(self.triangles, rim)
        if method == "membrane":
            if calibration.reference is None:
                raise SensorError("dense force: method 'membrane' needs the stress-free coordinates of the nodes "
                                  "(reference); give them, or use 'paper'.")
            shear = calibration.stiffness / 3.0 if calibration.shear is None else calibration.shear
            self._membrane = NeoHookeanMembrane(calibration.reference, self.triangles, shear)
            # what the model finds unbalanced on the free dome, from its own coarseness or a modulus that is a little
            # off: tared
            self._tare = (self._membrane.forces(self.rest) - calibration.pressure
                          * nodal_areas(self.rest, self.triangles)).ravel()[self.free][:, None]
        else:
            modulus = RELEASED_STIFFNESS if method == "released" else calibration.stiffness
            full = plane_stress_stiffness(self.rest, self.triangles, modulus, poisson_ratio=calibration.poisson_ratio)
            if method == "taut":
                tension = uniform_tension(self.rest, self.triangles, calibration.pressure, self.inner)
                full = full + tension_stiffness(self.rest, self.triangles,
                                                tension) - calibration.pressure * pressure_stiffness(self.rest,
                                                                                                     self.triangles)
            self._stiffness = self._cut(full)
        self._program = self._weights()

    def estimate(self, position: np.ndarray, pressure: np.ndarray) -> DenseForce:
        """Forces of T frames.

        Args:
            position: measured node positions, mount frame (T, n, 3) [m]; the rim's are taken as clamped. pressure:
            gauge pressure (T,) [Pa].

        Raises:
            SensorError: shapes that do not fit, or a number that is not finite.
        """
        position, pressure = np.asarray(position, np.float64), np.asarray(pressure, np.float64)
        if position.ndim != 3 or position.shape[1:] != self.rest.shape or pressure.shape != position.shape[:1]:
            raise SensorError(f"dense force: positions {position.shape} and pressures {pressure.shape}; give (T, "
                              f"{len(self.rest)}, 3) and (T,).")
        if not (np.isfinite(position).all() and np.isfinite(pressure).all()):
            raise SensorError("dense force: a measured position or pressure is not finite; leave out frames that "
                              "were not read.")
        if not len(position):  # no frame was read
            return DenseForce(np.zeros(position.shape), position.copy(), np.zeros(0), np.zeros(0, bool))
        seen = np.broadcast_to(self.rest, position.shape).copy()
        seen[:, self.inner] = position[:, self.inner]
        measured = (seen - self.rest).reshape(len(seen), -1)[:, self.free].T  # (3 n, T)
        if self.method == "membrane":
            return self._nonlinear(seen, pressure, measured)
        offset = -self._air(seen, pressure - self.calibration.pressure)
        if self.method == "residual":
            return self._result(measured, self._stiffness @ measured + offset, np.zeros(len(seen)),
                                np.ones(len(seen), bool))
        inward = np.stack([-nodal_normals(x, self.triangles)[self.inner] for x in seen], axis=1)
        found = solve(self._stiffness, offset, measured, self._program, inward=inward, edges=self._edges)
        if self.method == "taut":
            return self._result(found.displacement, found.force, found.residual, found.converged)
        # as the public code: the forces that the found displacements mean, not their sparse twin
        return self._result(found.displacement, self._stiffness @ found.displacement + offset, found.residual,
                            found.converged)

    def _weights(self) -> ForceProgram:
        o = self.options
        precision = o.displacement_std**-2
        program = ForceProgram(precision, tolerance=o.tolerance, iterations=o.iterations)
        if self.method == "paper":
            return replace(program, ridge=o.force_scale**-2)
        if self.method == "released":
            # |.|^2 k = w/2 |.|^2
            return replace(program,
                           weight=2.0 * RELEASED_DISPLACEMENT
                           * (np.asarray(self.calibration.rim).sum() / len(self.rest)) ** 2, lasso=RELEASED_FORCE)
        if self.method == "taut":
            # spikes come from the noise of the nodes; the model's own error is as smooth as the press, so it calls for
            # no more smoothing
            share = o.displacement_std**2 / (o.displacement_std**2 + o.model_std**2)
            return replace(program, weight=share * precision, lasso=1.0 / o.force_scale,
                           smooth=share * o.neighbour_scale**-2, friction=o.friction)
        return replace(program, lasso=1.0 / o.force_scale, smooth=o.neighbour_scale**-2, friction=o.friction)

    def _cut(self, matrix: sparse.csr_matrix) -> sparse.csr_matrix:
        return matrix.tocsr()[self.free][:, self.free]

    def _air(self, points: np.ndarray, pressure: np.ndarray) -> np.ndarray:
        """Force of the air on the free degrees of freedom (3 n, T) [N]; points (T, n, 3), pressure (T,) [Pa]."""
        return np.stack([(p * nodal_areas(x, self.triangles)).ravel()[self.free] for x,
                         p in zip(points, pressure, strict=True)], axis=1)

    def _nonlinear(self, seen: np.ndarray, pressure: np.ndarray, measured: np.ndarray) -> DenseForce:
        """Gauss-Newton: every round linearises the skin and the air about the last answer, at first the measured
        shape."""
        force, residual = np.zeros_like(measured), np.zeros(len(seen))
        displacement = measured.copy()
        converged = np.ones(len(seen), bool)
        for t in range(len(seen)):
            x, found = seen[t], None
            for _ in range(self.options.rounds):
                tangent = self._cut(self._membrane.tangent(x) - pressure[t] * pressure_stiffness(x, self.triangles))
                here = (x - self.rest).ravel()[self.free][:, None]
                out = (self._membrane.forces(x) - pressure[t] * nodal_areas(x,
                                                                            self.triangles)).ravel()[self.free][:,
                                                                                                                None] - self._tare
                inward = -nodal_normals(x, self.triangles)[self.inner][:, None]
                found = solve(tangent, out - tangent @ here, measured[:, t:t + 1], self._program, inward=inward,
                              edges=self._edges, start=None if found is None else found.start)
                x = self.rest.copy()
                x.ravel()[self.free] += found.displacement[:, 0]
            assert found is not None
            force[:, t], displacement[:, t] = found.force[:, 0], found.displacement[:, 0]
            residual[t], converged[t] = found.residual[0], found.converged[0]
        return self._result(displacement, force, residual, converged)

    def _result(self, displacement: np.ndarray, force: np.ndarray, residual: np.ndarray,
                converged: np.ndarray) -> DenseForce:
        def full(columns: np.ndarray) -> np.ndarray:
            out = np.zeros((columns.shape[1], *self.rest.shape))
            out.reshape(len(out), -1)[:, self.free] = columns.T
            return out

        return DenseForce(full(force), self.rest + full(displacement), residual, converged)
