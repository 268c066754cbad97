"""The convex program of the force estimator: displacements near the measured ones with few, small, inward forces.

    min_u  1/2 w |u - d|^2 + sum_i ( lambda |f_i| + kappa/2 |f_i|^2 ) + s/2 sum_ij |f_i - f_j|^2   with  f = K u + c,
    f_i in C_i

Here d are the measured displacements, K and c are a linear model of the forces, C_i is all of space or the Coulomb
friction cone about the inward normal, and ij are the edges of the mesh. The group lasso lambda makes nodes without
contact exactly free of force. kappa alone (ridge) gives a quadratic program. s smooths the forces between neighbours;
without it noise, which K amplifies between neighbours, leaves spikes.

The alternating direction method of multipliers (Boyd et al. 2011) splits f off: its step is a projection onto the cone
and a shrinkage, and the step of u has one sparse factor for all columns. The optimality conditions are measured at the
end.
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
class ForceProgram:
    """Weights of one program."""

    weight: float | np.ndarray
    """w, one over the variance of a displacement [1/m^2]: one number, or one for each degree of freedom (3 n,)."""
    lasso: float = 0.0
    """lambda [1/N]."""
    ridge: float = 0.0
    """kappa [1/N^2]."""
    smooth: float = 0.0
    """s [1/N^2]."""
    friction: float | None = None
    """Coefficient of the friction cone [-]; None for no cone, infinity for the half-space of inward forces."""
    tolerance: float = 1e-4
    """Of the optimality conditions, relative [-]."""
    iterations: int = 4000
    """Largest number of iterations."""

    def __post_init__(self) -> None:
        weight = np.asarray(self.weight, float)
        if not (np.isfinite(weight).all() and (weight > 0.0).all()):
            raise SensorError("force program: weight must be greater than 0 everywhere, in 1/m^2 (one over the "
                              "variance of a displacement).")
        for name, value in (("lasso", self.lasso), ("ridge", self.ridge), ("smooth", self.smooth)):
            if not 0.0 <= value < np.inf:
                raise SensorError(f"force program: {name} is {value!r}; it must be at least 0 and finite.")
        if self.friction is not None and not self.friction > 0.0:
            raise SensorError(f"force program: friction is {self.friction!r}; it must be greater than 0, or None "
                              f"for no cone.")


@dataclass(frozen=True)
class Solution:
    """Solution of `solve`."""

    displacement: np.ndarray
    """u (3 n, T) [m]."""
    force: np.ndarray
    """f (3 n, T) [N], in the cone, and exactly 0 where the lasso frees a node."""
    residual: np.ndarray
    """Of the optimality conditions (T,) [-]: the larger of |f - K u - c| over |K d + c| and of the stationarity in u
    over the size of its terms."""
    iterations: int
    start: tuple[np.ndarray, np.ndarray, float] | None = None
    """Warm start for a similar program: forces (3 n, T) [N], scaled multipliers (3 n, T) [N] and penalty [-]; see
    `solve`."""

    @property
    def converged(self) -> np.ndarray:
        """True (T,) where the residual is below 1e-3, far below the noise of a sensor."""
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


def prox(force: np.ndarray, step: float, program: ForceProgram, inward: np.ndarray | None) -> np.ndarray:
    """argmin_f  |f - force|^2 / (2 step) + lambda |f| + kappa/2 |f|^2 over the cone, node by node (..., 3) [N]."""
    out = force
    if program.friction is not None:
        assert inward is not None  # see solve
        out = project_cone(force, inward, program.friction)
    size = np.linalg.norm(out, axis=-1, keepdims=True)
    return out * np.maximum(1.0 - step * program.lasso / np.maximum(size, 1e-300), 0.0) / (1.0 + step * program.ridge)


def solve(stiffness: sparse.spmatrix, offset: np.ndarray, measured: np.ndarray, program: ForceProgram, *,
          inward: np.ndarray | None = None, edges: np.ndarray | None = None,
          start: tuple[np.ndarray, np.ndarray, float] | None = None) -> Solution:
    """Solve the program for T right-hand sides that share K.

    Args:
        stiffness: K (3 n, 3 n) [N/m], free degrees of freedom only.
        offset: c (3 n, T) [N].
        measured: d (3 n, T) [m].
        program: weights.
        inward: unit normals into the sensor for every column (n, T, 3); needed with a cone.
        edges: pairs of neighbours among the n nodes (e, 2); needed with ``smooth``.
        start: `Solution.start` of a similar program.

    Raises:
        SensorError: shapes that do not match, or numbers that are not finite.
    """
    size = stiffness.shape[0]
    if offset.shape != measured.shape or len(measured) != size or stiffness.shape != (size, size) or size % 3:
        raise SensorError(f"force program: stiffness {stiffness.shape}, offset {offset.shape} and measured "
                          f"{measured.shape}; give (3 n, 3 n), (3 n, T) and (3 n, T).")
    if not (np.isfinite(offset).all() and np.isfinite(measured).all() and np.isfinite(stiffness.data).all()):
        raise SensorError("force program: a stiffness, offset or measured displacement is not finite; leave out frames "
                          "that were not read.")
    if program.friction is not None and (inward is None or inward.shape != (size // 3, measured.shape[1], 3)):
        raise SensorError(f"force program: a cone needs inward normals ({size // 3}, {measured.shape[1]}, 3).")
    if program.smooth and edges is None:
        raise SensorError("force program: smooth needs the edges of the mesh, (e, 2).")
    weight = np.broadcast_to(np.asarray(program.weight, float), (size,))
    stiffness = sparse.csr_matrix(stiffness)
    rough = sparse.csr_matrix((size, size))
    if program.smooth and edges is not None:
        rough = program.smooth * roughness(edges, size // 3)
    if program.lasso == 0.0 and program.friction is None:
        return _ridge(stiffness, offset, measured, weight, program.ridge * sparse.identity(size, format="csr") + rough)
    return _admm(stiffness, offset, measured, weight, program, inward, rough, start)


def roughness(edges: np.ndarray, nodes: int) -> sparse.csr_matrix:
    """Graph Laplacian R (3 n, 3 n) for x, y and z: f . R f = sum over the edges (e, 2) of |f_i - f_j|^2."""
    i, j = np.asarray(edges).T
    one = np.ones(len(i))
    graph = sparse.csr_matrix((np.concatenate([one, one, -one, -one]),
                               (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))), shape=(nodes, nodes))
    return sparse.kron(graph, sparse.identity(3)).tocsr()


def _ridge(k: sparse.csr_matrix, c: np.ndarray, d: np.ndarray, weight: np.ndarray,
           quadratic: sparse.csr_matrix) -> Solution:
    """Normal equations of the quadratic program without a cone, whose objective has the term f . quadratic f / 2."""
    pulled = k.T @ quadratic
    factor = splu(sparse.csc_matrix(sparse.diags(weight) + pulled @ k))
    u = factor.solve(weight[:, None] * d - pulled @ c)
    f = k @ u + c
    gradient = weight[:, None] * (u - d) + pulled @ f
    scale = np.linalg.norm(weight[:, None] * d, axis=0) + np.linalg.norm(pulled @ c, axis=0)
    return Solution(u, f, np.linalg.norm(gradient, axis=0) / np.maximum(scale, 1e-300), 1)


def _admm(k: sparse.csr_matrix, c: np.ndarray, d: np.ndarray, weight: np.ndarray, program: ForceProgram,
          inward: np.ndarray | None, rough: sparse.csr_matrix,
          start: tuple[np.ndarray, np.ndarray, float] | None) -> Solution:
    gram = sparse.csc_matrix(k.T @ k)
    transposed = sparse.csr_matrix(k.T)
    pulled = sparse.csr_matrix(transposed @ rough)
    fixed = sparse.csc_matrix(sparse.diags(weight) + pulled @ k)
    # The penalty balances the weight against the geometric mean of K^T K; the factor 100 takes the fewest iterations
    # on bubbles.
    rho = 100.0 * float(weight.mean() / np.sqrt(gram.diagonal().mean() * max(gram.diagonal().min(), 1e-12)))
    f = k @ d + c
    raw = np.maximum(np.linalg.norm(f, axis=0), 1e-9)  # forces below a nanonewton are treated as zero
    scaled = np.zeros_like(f)  # multipliers over rho
    if start is not None:
        f, scaled, rho = start[0].copy(), start[1].copy(), start[2]
    out_u, out_f, out_dual, done = np.empty_like(f), np.empty_like(f), np.empty_like(f), np.full(d.shape[1], np.inf)
    open_ = np.arange(d.shape[1])  # columns that are not solved yet
    factor, iteration = None, 0
    aim = weight[:, None] * d - pulled @ c
    while len(open_):
        iteration += 1
        if factor is None:
            factor = splu(sparse.csc_matrix(fixed + rho * gram))
        u = factor.solve(aim + rho * (transposed @ (f - scaled - c)))
        forward = k @ u + c
        mixed = _RELAXATION * forward + (1.0 - _RELAXATION) * f
        before = f
        split = np.moveaxis((mixed + scaled).reshape(len(d) // 3, 3, -1), 1, 2)
        f = np.moveaxis(prox(split, 1.0 / rho, program, inward), 2, 1).reshape(d.shape)
        scaled = scaled + mixed - f
        if iteration % _CHECK and iteration < program.iterations:
            continue
        primal = np.linalg.norm(forward - f, axis=0) / raw
        pull = rho * (transposed @ scaled)
        terms = np.maximum(np.linalg.norm(pull, axis=0), np.linalg.norm(weight[:, None] * (u - d), axis=0))
        terms = np.maximum(terms, 1e-9 * weight.mean())  # a nanometre
        dual = np.linalg.norm(weight[:, None] * (u - d) + pulled @ forward + pull, axis=0) / terms
        dual = np.maximum(dual, rho * np.linalg.norm(transposed @ (f - before), axis=0) / terms)
        done[open_] = np.maximum(primal, dual)
        out_u[:, open_], out_f[:, open_], out_dual[:, open_] = u, f, rho * scaled
        left = done[open_] >= program.tolerance
        if iteration >= program.iterations or not left.any():
            break
        ratio = float(np.median(primal[left]) / max(np.median(dual[left]), 1e-300))
        if not left.all():
            open_, raw = open_[left], raw[left]
            c, d, aim, f, scaled = (columns[:, left] for columns in (c, d, aim, f, scaled))
            inward = None if inward is None else inward[:, left]
        if (ratio > _BALANCE or ratio < 1.0 / _BALANCE) and iteration % (5 * _CHECK) == 0:
            factor_of = float(np.clip(np.sqrt(ratio), 0.2, 5.0))
            rho *= factor_of
            scaled = scaled / factor_of
            factor = None
    return Solution(out_u, out_f, done, iteration, (out_f, out_dual / rho, rho))
