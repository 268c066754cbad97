"""The press in scikit-fem: quadratic tetrahedra, the same law, a penalty at the quadrature points of the top.

Runs in a venv of its own with scikit-fem; nothing of vsfsim is imported. Newton's method with SuperLU and a line search
on the energy. The penalty is `STIFF` times the modulus over an edge. A case with rows of a foam has the law of
`references/hyperfoam.py`, which is written anew from the energy.
"""

import numpy as np
import skfem
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

from references import hyperfoam

STIFF = 300.0  # penalty over E / edge [-]
MOST = 40  # Newton iterations of a frame
TOLERANCE = 1e-6  # unbalanced force over the contact force [-]
LONGEST = 0.0005  # way from one equilibrium to the next [m]


class NeoHooke:
    """W = mu/2 (I_c - 3) - mu ln J + lambda/2 (ln J)^2, with mu and lambda (m, 1) [Pa]; see `hyperfoam`."""

    def __init__(self, mu, lam):
        self.mu, self.lam = mu, lam

    def energy(self, f):
        """(m, q) [Pa] of deformation gradients (m, q, 3, 3)."""
        log = np.log(np.linalg.det(f))
        return 0.5 * self.mu * ((f**2).sum(axis=(2, 3)) - 3.0) - self.mu * log + 0.5 * self.lam * log**2

    def stress(self, f):
        """(m, q, 3, 3) [Pa]."""
        log = np.log(np.linalg.det(f))
        across = np.swapaxes(np.linalg.inv(f), 2, 3)
        return self.mu[..., None, None] * f + (self.lam * log - self.mu)[..., None, None] * across

    def moduli(self, f):
        """(m, q, 3, 3, 3, 3) [Pa]."""
        log = np.log(np.linalg.det(f))
        across, eye = np.swapaxes(np.linalg.inv(f), 2, 3), np.eye(3)
        wide = (..., None, None, None, None)
        return (self.mu[wide] * np.einsum("ik,jl->ijkl", eye, eye)
                + np.broadcast_to(self.lam, log.shape)[wide] * np.einsum("mqij,mqkl->mqijkl", across, across)
                + (self.mu - self.lam * log)[wide] * np.einsum("mqil,mqkj->mqijkl", across, across))


class Foam:
    """The hyperfoam law with rows (k, 3) of mu [Pa], alpha and beta."""

    def __init__(self, rows):
        self.rows = rows

    def __getattr__(self, name):
        return lambda f: getattr(hyperfoam, name)(f, self.rows)


def make(given):
    """See `measurements.indent.pressing`."""
    mesh = skfem.MeshTet(given["points"].T.copy(), given["tets"].T.astype(np.int64).copy())
    radius, edge, ratio = float(given["radius"]), float(given["edge"]), float(given["ratio"])
    element = skfem.ElementVector(skfem.ElementTetP2())
    basis = skfem.Basis(mesh, element, intorder=3)
    high = mesh.p[2].max()
    top = mesh.facets_satisfying(lambda x: np.abs(x[2] - high) < 1e-9, boundaries_only=True)
    face = skfem.FacetBasis(mesh, element, facets=top, intorder=6)
    young = given["young"][:, None]  # SKFEM keeps the order of the elements
    mu = young / 2.0 / (1.0 + ratio)
    law = Foam(given["foam"]) if "foam" in given else NeoHooke(mu, 2.0 * mu * ratio / (1.0 - 2.0 * ratio))
    free = basis.complement_dofs(basis.get_dofs(lambda x: np.abs(x[2]) < 1e-9))
    penalty = STIFF * float(given["young"].min()) / edge
    centre = np.zeros(3)  # of the ball
    # gradient of every shape function (m, q, 9, 30), and the unknowns of each element (m, 30)
    shapes = np.stack([np.moveaxis(np.broadcast_to(np.asarray(one[0].grad), (3, 3, *basis.dx.shape)), (2, 3), (0, 1))
                       .reshape(*basis.dx.shape, 9) for one in basis.basis], axis=-1)
    unknowns = basis.element_dofs.T
    rows, columns = np.repeat(unknowns, unknowns.shape[1], axis=1).ravel(), np.tile(unknowns, unknowns.shape[1]).ravel()

    def deformation(u):
        return np.eye(3) + (shapes @ u[unknowns][:, None, :, None])[..., 0].reshape(*basis.dx.shape, 3, 3)

    def inside(f):
        local = (basis.dx[..., None] * law.stress(f).reshape(*basis.dx.shape, 9))[..., None, :] @ shapes
        return np.bincount(unknowns.ravel(), local.sum(axis=(1, 2)).ravel(), basis.N)

    def tangent(f):
        half = basis.dx[..., None, None] * law.moduli(f).reshape(*basis.dx.shape, 9, 9) @ shapes
        local = (np.swapaxes(shapes, 2, 3) @ half).sum(axis=1)
        return coo_matrix((local.ravel(), (rows, columns)), (basis.N, basis.N)).tocsr()

    def energy(f):
        return np.inf if np.linalg.det(f).min() <= 0.0 else float((basis.dx * law.energy(f)).sum())

    def gap(w):
        away = w.x + w["u"] - centre.reshape(3, 1, 1)
        far = np.sqrt((away**2).sum(axis=0))
        return far - radius, away / far, far

    @skfem.LinearForm
    def push(v, w):
        g, n, _ = gap(w)
        return penalty * np.minimum(g, 0.0) * np.einsum("i...,i...->...", n, v)

    @skfem.BilinearForm
    def push_tangent(u, v, w):
        g, n, far = gap(w)
        nu, nv = (np.einsum("i...,i...->...", n, f) for f in (u, v))
        across = np.einsum("i...,i...->...", u, v) - nu * nv
        return np.where(g < 0.0, penalty * (nu * nv + g / far * across), 0.0)

    @skfem.Functional
    def push_energy(w):
        return 0.5 * penalty * np.minimum(gap(w)[0], 0.0) ** 2

    @skfem.Functional
    def lift(w):
        g, n, _ = gap(w)
        return -penalty * np.minimum(g, 0.0) * n[2]

    def stored(u):
        return energy(deformation(u)) + push_energy.assemble(face, u=face.interpolate(u))

    u, reached = basis.zeros(), 0.0

    def settled(depth: float) -> tuple[float, float]:
        nonlocal u
        centre[:] = [*given["at"], high + radius - depth]
        for _ in range(MOST):
            f, on = deformation(u), face.interpolate(u)
            own = inside(f)
            contact = push.assemble(face, u=on)
            rest = (own + contact)[free]
            size = max(np.abs(contact).sum(), 1e-6)
            if np.abs(rest).sum() < TOLERANCE * size:
                break
            matrix = (tangent(f) + push_tangent.assemble(face, u=on))[free][:, free]
            step = np.zeros_like(u)
            step[free] = -splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True},
                               diag_pivot_thresh=0.01).solve(rest)
            now, part = stored(u), 1.0
            while part > 1e-3 and not stored(u + part * step) <= now + 1e-4 * part * (rest @ step[free]):
                part *= 0.5
            u = u + part * step
        return -float(lift.assemble(face, u=face.interpolate(u))), float(np.abs(rest).sum() / size)

    def press(depth: float) -> tuple[float, float]:
        nonlocal reached
        ways = np.linspace(reached, depth, max(1, round((depth - reached) / LONGEST)) + 1)[1:]
        reached = depth
        return [settled(float(way)) for way in ways][-1]

    settings = (f"quadratic tetrahedra, the law of the reference, Newton's method with a direct solver until "
                f"{TOLERANCE:g} of the force is unbalanced, steps of {1e3 * LONGEST:g} mm, penalty of {STIFF:g} times "
                f"the modulus over an edge")
    return skfem.__version__, settings, press
