"""Contact forces on the nodes of an air-filled bubble, estimated from noisy displacements and the pressure.

Neural VSF, section III-A, says this much: the contact forces are what is left of the equilibrium of air and skin; the
air's force is "the internal pressure reading multiplied by the triangle area"; "a calibrated linear FEM model" gives
the skin's, f_elastic = K u; and "a Quadratic Programming (QP) formulation is used to regularize the estimated forces".
It gives no objective, no constraint and no weight. Its reference [31] (Peng, Yao and Hauser, ICRA 2024) and the public
code of [31] give them: K is plane stress about the inflated dome without tension, E h 737.1 N/m, nu 0.5; the air's
force is the pressure *change* times the measured area; the rim is held; and

    min_u  sum_i k_disp |u_i - d_i|^2  +  k_force sum_i |f_i|      (or k_force sum_i |f_i|^2: the quadratic program),
    f = K u - dp a(x)

with d the tracked displacements. There is no constraint on the forces. The methods are:

    residual   f = K d - dp a
    paper      the quadratic program (squared forces)
    membrane   ours, if the stress-free shape is known: a neo-Hookean skin at the measured shape under the full
               pressure, relinearised about its own solution; the objective is the sum of norms with smoothing between
               neighbours, and forces lie in a friction cone about the inward normal

The program of `membrane` finds displacements near the measured ones with few, small, inward forces.

    min_u  1/2 w |u - d|^2 + lambda sum_i |f_i| + s/2 sum_ij |f_i - f_j|^2   with  f = K u + c,  f_i in C_i

Here d are the measured displacements, K and c are a linear model of the forces, C_i is the Coulomb friction cone about
the inward normal, and ij are the edges of the mesh. The group lasso lambda makes nodes without contact exactly free of
force. s smooths the forces between neighbours; without it noise, which K amplifies between neighbours, leaves spikes.

The alternating direction method of multipliers (Boyd et al. 2011) splits f off: its step is a projection onto the cone
and a shrinkage, and the step of u has one sparse factor. The optimality conditions are measured at the end. `ridge` is
the quadratic program with kappa/2 |f|^2 in place of lasso, smoothing and cone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from vsfsim.core.errors import did_you_mean
from vsfsim.physics.elements import gas, triangle
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.sensing.membrane_fe import (
    SensorError,
    checked_mesh,
    in_their_planes,
    nodal_areas,
    nodal_normals,
    skin_forces,
)

METHODS = ("residual", "paper", "membrane")
_ROUNDS = 2  # linearisations of `membrane`
_RELAXATION = 1.6  # over-relaxation; 1.5 to 1.8 is usual (Boyd et al. 2011, section 3.4.3)
_CHECK = 20  # iterations between measurements of the residuals
_BALANCE = 5.0  # ratio of the residuals from which the penalty is changed


@dataclass(frozen=True)
class EstimatorOptions:
    """Weights of an estimate."""

    displacement_std: float = 5e-5
    """Noise of a node's displacement, per component [m]; w = 1 / noise^2."""
    force_scale: float = 0.05
    """Scale of a node's force [N]; lambda is its inverse and kappa its inverse square."""
    neighbour_scale: float = 0.2
    """Expected difference of the forces on neighbouring nodes in contact [N], infinity for no smoothing; s is its
    inverse square. `membrane` only."""
    friction: float = 1.0
    """Coefficient of the friction cone [-], infinity for the half-space of inward forces; `membrane` only."""
    tolerance: float = 1e-4
    """Of the program's optimality conditions, relative [-]."""
    iterations: int = 4000
    """Largest number of iterations of the program."""

    def __post_init__(self) -> None:
        for name in ("displacement_std", "force_scale", "neighbour_scale", "friction", "tolerance"):
            value = getattr(self, name)
            if not 0.0 < value:
                raise SensorError(f"dense force: {name} is {value!r}; it must be greater than 0.")
        if self.iterations < 1:
            raise SensorError(f"dense force: iterations is {self.iterations}; give at least 1.")


@dataclass(frozen=True)
class BubbleCalibration:
    """Calibration data of one bubble."""

    rest: np.ndarray
    """Read-out nodes of the free dome, mount frame (n, 3) [m]."""
    triangles: np.ndarray
    """Of the read-out mesh, wound outwards (m, 3)."""
    rim: np.ndarray
    """True at the clamped nodes (n,)."""
    stiffness: float
    """E h of the skin [N/m]."""
    pressure: float
    """Gauge pressure of the free dome [Pa]."""
    reference: np.ndarray | None = None
    """Stress-free material coordinates (n, 2) [m]; None if unknown. Method `membrane` needs them."""


@dataclass(frozen=True)
class DenseForce:
    """The estimate of T frames."""

    force: np.ndarray
    """Contact force on each node, mount frame (T, n, 3) [N]; 0 on the rim."""
    position: np.ndarray
    """Node positions of the estimate (T, n, 3) [m]."""
    residual: np.ndarray
    """Of the program's optimality conditions (T,) [-]; 0 for method `residual`."""
    converged: np.ndarray
    """True where the residual is below 1e-3 (T,)."""


def inner_edges(triangles: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Edges (e, 2) between free nodes, indexed among the free nodes; triangles (m, 3), rim (n,) bool."""
    pairs = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    return (np.cumsum(~rim) - 1)[pairs[~rim[pairs].any(axis=1)]]


class DenseForceEstimator:
    """Forces on the nodes of one bubble.

    Args:
        calibration: of the bubble.
        method: one of `METHODS`.
        options: weights.

    Raises:
        SensorError: an unknown method, an invalid calibration, or `membrane` without stress-free coordinates.
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
            self._shape = np.asarray(calibration.reference, np.float64)[self.triangles]
            edges = self._shape[:, 1:] - self._shape[:, :1]
            if not (np.linalg.det(edges) > 0.0).all():
                raise SensorError("dense force: a triangle of the reference has no area or is wound the other way.")
            # the unbalanced force of the free dome (discretisation, error of the modulus) is subtracted
            self._tare = self._unbalanced(self.rest, calibration.pressure)
        else:
            shape = in_their_planes(self.rest, self.triangles)
            skin = triangle.block(self.triangles, self.rest, shape, calibration.stiffness)
            self._stiffness = self._cut(assemble(len(self.rest), (skin,)))

    def estimate(self, position: np.ndarray, pressure: np.ndarray) -> DenseForce:
        """Forces of T frames.

        Args:
            position: measured node positions, mount frame (T, n, 3) [m]; the rim is taken as clamped.
            pressure: gauge pressure (T,) [Pa].

        Raises:
            SensorError: shapes that do not match, or a number that is not finite.
        """
        position, pressure = np.asarray(position, np.float64), np.asarray(pressure, np.float64)
        if position.ndim != 3 or position.shape[1:] != self.rest.shape or pressure.shape != position.shape[:1]:
            raise SensorError(f"dense force: positions {position.shape} and pressures {pressure.shape}; give (T, "
                              f"{len(self.rest)}, 3) and (T,).")
        if not (np.isfinite(position).all() and np.isfinite(pressure).all()):
            raise SensorError("dense force: a measured position or pressure is not finite; leave out frames that "
                              "were not read.")
        if not len(position):
            return DenseForce(np.zeros(position.shape), position.copy(), np.zeros(0), np.zeros(0, bool))
        clamped = np.broadcast_to(self.rest, position.shape).copy()
        clamped[:, self.inner] = position[:, self.inner]
        measured = (clamped - self.rest).reshape(len(clamped), -1)[:, self.free].T  # (3 n, T)
        if self.method == "membrane":
            return self._nonlinear(clamped, pressure, measured)
        offset = -self._air(clamped, pressure - self.calibration.pressure)
        if self.method == "residual":
            return self._result(measured, self._stiffness @ measured + offset, np.zeros(len(clamped)),
                                np.ones(len(clamped), bool))
        found = ridge(self._stiffness, offset, measured, self.options)
        return self._result(found.displacement, found.force, found.residual, found.converged)

    def _cut(self, matrix: sparse.csr_matrix) -> sparse.csr_matrix:
        return matrix.tocsr()[self.free][:, self.free]

    def _air(self, points: np.ndarray, pressure: np.ndarray) -> np.ndarray:
        """Force of the air on the free degrees of freedom (3 n, T) [N]; points (T, n, 3), pressure (T,) [Pa]."""
        return np.stack([(p * nodal_areas(x, self.triangles)).ravel()[self.free]
                         for x, p in zip(points, pressure, strict=True)], axis=1)

    def _unbalanced(self, points: np.ndarray, pressure: float) -> np.ndarray:
        """What skin and air leave on the free degrees of freedom (3 n,) [N]."""
        skin = skin_forces(points, self.triangles, self._shape, self.calibration.stiffness)
        return (skin - pressure * nodal_areas(points, self.triangles)).ravel()[self.free]

    def _tangent(self, points: np.ndarray, pressure: float) -> sparse.csr_matrix:
        """The change of `_unbalanced` with the free degrees of freedom (3 n, 3 n) [N/m]."""
        skin = triangle.block(self.triangles, points, self._shape, self.calibration.stiffness)
        air = gas.block(self.triangles, points, pressure=pressure, volume=1.0, sealed=False)
        return self._cut(assemble(len(points), (skin, air)))

    def _nonlinear(self, position: np.ndarray, pressure: np.ndarray, measured: np.ndarray) -> DenseForce:
        """Gauss-Newton: every round linearises skin and air about the last solution, the first about the measured
        shape."""
        force, residual = np.zeros_like(measured), np.zeros(len(position))
        displacement = measured.copy()
        converged = np.ones(len(position), bool)
        for t in range(len(position)):
            x, found = position[t], None
            for _ in range(_ROUNDS):
                tangent = self._tangent(x, pressure[t])
                here = (x - self.rest).ravel()[self.free]
                out = self._unbalanced(x, pressure[t]) - self._tare
                found = solve(tangent, out - tangent @ here, measured[:, t], self.options,
                              inward=-nodal_normals(x, self.triangles)[self.inner], edges=self._edges,
                              start=None if found is None else found.start)
                x = self.rest.copy()
                x.ravel()[self.free] += found.displacement
            assert found is not None
            force[:, t], displacement[:, t] = found.force, found.displacement
            residual[t], converged[t] = found.residual, found.converged
        return self._result(displacement, force, residual, converged)

    def _result(self, displacement: np.ndarray, force: np.ndarray, residual: np.ndarray,
                converged: np.ndarray) -> DenseForce:
        def full(columns: np.ndarray) -> np.ndarray:
            out = np.zeros((columns.shape[1], *self.rest.shape))
            out.reshape(len(out), -1)[:, self.free] = columns.T
            return out

        return DenseForce(full(force), self.rest + full(displacement), residual, converged)


@dataclass(frozen=True)
class Solution:
    """Solution of `solve` or `ridge`."""

    displacement: np.ndarray
    """u (3 n,) or (3 n, T) [m]."""
    force: np.ndarray
    """f (3 n,) or (3 n, T) [N], in the cone, and exactly 0 where the lasso frees a node."""
    residual: np.ndarray
    """Of the optimality conditions () or (T,) [-]: the larger of |f - K u - c| over |K d + c| and of the stationarity
    in u over the size of its terms."""
    start: tuple[np.ndarray, np.ndarray, float] | None = None
    """Warm start for a similar program: forces (3 n,) [N], scaled multipliers (3 n,) [N] and penalty [-]; see
    `solve`."""

    @property
    def converged(self) -> np.ndarray:
        """True () or (T,) where the residual is below 1e-3, far below the noise of a sensor."""
        return self.residual < 1e-3


def project_cone(force: np.ndarray, inward: np.ndarray, friction: float) -> np.ndarray:
    """Nearest force (..., 3) in the cone |tangential| <= friction (force . inward) about unit normals ``inward``;
    infinity for a half-space."""
    normal = np.einsum("...i,...i->...", force, inward)
    if np.isinf(friction):
        return force - np.minimum(normal, 0.0)[..., None] * inward
    tangential = force - normal[..., None] * inward
    size = np.linalg.norm(tangential, axis=-1)
    inside = size <= friction * normal
    polar = friction * size <= -normal
    along = np.maximum((normal + friction * size) / (1.0 + friction**2), 0.0)
    edge = along[..., None] * (inward + friction * tangential / np.maximum(size, 1e-300)[..., None])
    return np.where(inside[..., None], force, np.where(polar[..., None], 0.0, edge))


def prox(force: np.ndarray, step: float, options: EstimatorOptions, inward: np.ndarray) -> np.ndarray:
    """argmin_f  |f - force|^2 / (2 step) + lambda |f| over the cone, node by node (n, 3) [N]."""
    out = project_cone(force, inward, options.friction)
    size = np.linalg.norm(out, axis=-1, keepdims=True)
    return out * np.maximum(1.0 - step / options.force_scale / np.maximum(size, 1e-300), 0.0)


def roughness(edges: np.ndarray, nodes: int) -> sparse.csr_matrix:
    """Graph Laplacian R (3 n, 3 n) for x, y and z: f . R f = sum over the edges (e, 2) of |f_i - f_j|^2."""
    i, j = np.asarray(edges).T
    one = np.ones(len(i))
    graph = sparse.csr_matrix((np.concatenate([one, one, -one, -one]),
                               (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))), shape=(nodes, nodes))
    return sparse.kron(graph, sparse.identity(3)).tocsr()


def ridge(k: sparse.csr_matrix, c: np.ndarray, d: np.ndarray, options: EstimatorOptions) -> Solution:
    """The quadratic program for T right-hand sides, by its normal equations.

    Args:
        k: K (3 n, 3 n) [N/m]. c: (3 n, T) [N]. d: (3 n, T) [m]. options: weights.
    """
    weight, kappa = options.displacement_std**-2, options.force_scale**-2
    pulled = kappa * k.T
    u = splu(sparse.csc_matrix(weight * sparse.identity(len(d)) + pulled @ k)).solve(weight * d - pulled @ c)
    f = k @ u + c
    scale = np.linalg.norm(weight * d, axis=0) + np.linalg.norm(pulled @ c, axis=0)
    return Solution(u, f, np.linalg.norm(weight * (u - d) + pulled @ f, axis=0) / np.maximum(scale, 1e-300))


def solve(stiffness: sparse.spmatrix, offset: np.ndarray, measured: np.ndarray, options: EstimatorOptions, *,
          inward: np.ndarray, edges: np.ndarray,
          start: tuple[np.ndarray, np.ndarray, float] | None = None) -> Solution:
    """Solve the program.

    Args:
        stiffness: K (3 n, 3 n) [N/m], free degrees of freedom only.
        offset: c (3 n,) [N].
        measured: d (3 n,) [m].
        options: weights.
        inward: unit normals into the sensor (n, 3).
        edges: pairs of neighbours among the n nodes (e, 2).
        start: `Solution.start` of a similar program.
    """
    k, c, d, weight = sparse.csr_matrix(stiffness), offset, measured, options.displacement_std**-2
    transposed = sparse.csr_matrix(k.T)
    gram = sparse.csc_matrix(transposed @ k)
    pulled = sparse.csr_matrix(transposed @ (options.neighbour_scale**-2 * roughness(edges, len(d) // 3)))
    fixed = sparse.csc_matrix(weight * sparse.identity(len(d)) + pulled @ k)
    # The penalty balances the weight against the geometric mean of K^T K; the factor 100 takes the fewest iterations
    # on bubbles.
    rho = 100.0 * float(weight / np.sqrt(gram.diagonal().mean() * max(gram.diagonal().min(), 1e-12)))
    f = k @ d + c
    raw = max(float(np.linalg.norm(f)), 1e-9)  # forces below a nanonewton are treated as zero
    scaled = np.zeros_like(f)  # multipliers over rho
    if start is not None:
        f, scaled, rho = start
    aim, factor, residual = weight * d - pulled @ c, None, np.inf
    for iteration in range(1, options.iterations + 1):
        if factor is None:
            factor = splu(sparse.csc_matrix(fixed + rho * gram))
        u = factor.solve(aim + rho * (transposed @ (f - scaled - c)))
        forward = k @ u + c
        mixed = _RELAXATION * forward + (1.0 - _RELAXATION) * f
        before = f
        f = prox((mixed + scaled).reshape(-1, 3), 1.0 / rho, options, inward).ravel()
        scaled = scaled + mixed - f
        if iteration % _CHECK and iteration < options.iterations:
            continue
        primal = float(np.linalg.norm(forward - f)) / raw
        pull, moved = rho * (transposed @ scaled), weight * (u - d)
        terms = max(float(np.linalg.norm(pull)), float(np.linalg.norm(moved)), 1e-9 * weight)  # a nanometre
        dual = max(float(np.linalg.norm(moved + pulled @ forward + pull)),
                   rho * float(np.linalg.norm(transposed @ (f - before)))) / terms
        residual = max(primal, dual)
        if residual < options.tolerance:
            break
        ratio = primal / max(dual, 1e-300)
        if not 1.0 / _BALANCE <= ratio <= _BALANCE and iteration % (5 * _CHECK) == 0:
            change = float(np.clip(np.sqrt(ratio), 0.2, 5.0))
            rho, scaled, factor = rho * change, scaled / change, None
    return Solution(u, f, np.array(residual), (f, scaled, rho))
