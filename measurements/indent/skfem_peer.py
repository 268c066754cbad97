"""The press in scikit-fem: quadratic tetrahedra, the same law, a penalty at the quadrature points of the top.

Runs in a venv of its own with scikit-fem; nothing of vsfsim is imported. Newton's method with SuperLU and a line search
on the energy. The penalty is `STIFF` times the modulus over an edge.
"""

import numpy as np
import skfem
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, det, grad, inv, transpose

STIFF = 300.0  # penalty over E / edge [-]
MOST = 40  # Newton iterations of a frame
TOLERANCE = 1e-6  # unbalanced force over the contact force [-]
LONGEST = 0.0005  # way from one equilibrium to the next [m]


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
    mu = np.broadcast_to(young / 2.0 / (1.0 + ratio), basis.dx.shape)
    lam = 2.0 * mu * ratio / (1.0 - 2.0 * ratio)
    free = basis.complement_dofs(basis.get_dofs(lambda x: np.abs(x[2]) < 1e-9))
    penalty = STIFF * float(given["young"].min()) / edge
    identity, centre = np.eye(3)[:, :, None, None], np.zeros(3)  # of the ball

    @skfem.BilinearForm
    def tangent(u, v, w):
        f = identity + grad(w["u"])
        g = transpose(inv(f))
        lnj = np.log(det(f))
        d = grad(u)
        middle = np.einsum("ij...,kj...,kl...->il...", g, d, g)
        return ddot(w["mu"] * d + (w["mu"] - w["lam"] * lnj) * middle + w["lam"] * ddot(g, d) * g, grad(v))

    @skfem.LinearForm
    def inside(v, w):
        f = identity + grad(w["u"])
        g = transpose(inv(f))
        return ddot(w["mu"] * (f - g) + w["lam"] * np.log(det(f)) * g, grad(v))

    @skfem.Functional
    def energy(w):
        f = identity + grad(w["u"])
        j = det(f)
        lnj = np.log(np.maximum(j, 1e-12))
        return np.where(j > 0.0, 0.5 * w["mu"] * (ddot(f, f) - 3.0) - w["mu"] * lnj + 0.5 * w["lam"] * lnj**2, 1e30)

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
        return (energy.assemble(basis, u=basis.interpolate(u), mu=mu, lam=lam)
                + push_energy.assemble(face, u=face.interpolate(u)))

    u, reached = basis.zeros(), 0.0

    def settled(depth: float) -> tuple[float, float]:
        nonlocal u
        centre[:] = [*given["at"], high + radius - depth]
        for _ in range(MOST):
            there, on = basis.interpolate(u), face.interpolate(u)
            own = inside.assemble(basis, u=there, mu=mu, lam=lam)
            contact = push.assemble(face, u=on)
            rest = (own + contact)[free]
            size = max(np.abs(contact).sum(), 1e-6)
            if np.abs(rest).sum() < TOLERANCE * size:
                break
            matrix = (tangent.assemble(basis, u=there, mu=mu, lam=lam)
                      + push_tangent.assemble(face, u=on))[free][:, free]
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
