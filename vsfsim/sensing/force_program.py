"""The convex programs of the force estimator: displacements near the measured ones with few, small, inward forces.

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

from vsfsim.sensing.membrane_fe import SensorError

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
