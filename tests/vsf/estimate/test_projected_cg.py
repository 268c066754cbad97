"""Projected conjugate gradients against exact solvers, and on the size of dense contact forces."""

import numpy as np
import pytest
from palpation import layer_with_inclusion, palpate
from scipy import optimize, sparse

from vsfsim.vsf.estimate.map import map_estimate, projected_cg
from vsfsim.vsf.estimate.pivoting import _line_search, principal_pivoting
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.sticking import stick

FIELD = layer_with_inclusion()


def dense_forces(spacing, half, *, touches, frames, **more):
    """Particles (n, 3) on a lattice of half-widths ``half`` under z = 0, touches, and their rows of contact forces."""
    axes = [np.arange(-h + 0.5 * spacing, h, spacing) for h in half] + [np.arange(-0.015 + 0.5 * spacing, 0.0, spacing)]
    particles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    pressed = palpate(FIELD, touches=touches, frames=frames, extent=(0.12, 0.08), **more)
    rows = [dense_force_rows(stick(particles, t.vertices, t.triangles), len(particles), t.triangles,
                             t.vertices.shape[1]) for t in pressed]
    return particles, pressed, sparse.vstack(rows).tocsr()


@pytest.mark.parametrize("m, n, strength", [(20, 8, 1.0), (8, 20, 1.0), (60, 40, 30.0), (40, 60, 100.0)])
def test_it_finds_the_minimiser(m, n, strength):
    rng = np.random.default_rng(m)
    a = strength * rng.normal(size=(m, n)) * (rng.uniform(size=(m, n)) < 0.4)
    b, x0 = strength * rng.normal(size=m), rng.normal(size=n)
    x, _ = projected_cg(sparse.csr_matrix(a), b, x0, start=x0, tolerance=1e-12)
    expected, _ = optimize.nnls(np.concatenate([a, np.eye(n)]), np.concatenate([b, x0]), maxiter=10_000)
    assert 0 < np.count_nonzero(expected == 0.0) < n
    np.testing.assert_allclose(x, expected, atol=1e-8 * max(1.0, np.abs(expected).max()))


def test_it_agrees_with_principal_pivoting_on_dense_forces():
    noise, mean, std, spacing = 0.05, 20.0, 30.0, 0.00363
    particles, _, w = dense_forces(spacing, (0.08, 0.06), touches=15, frames=8, substeps=1)
    z = w @ (FIELD(particles) * spacing**3) + noise * np.random.default_rng(1).standard_normal(w.shape[0])
    a = sparse.csr_matrix(w[:, np.unique(w.indices)]) * (std / noise)
    b, x0 = z / noise, np.full(a.shape[1], mean / std)
    x, _ = projected_cg(a, b, x0, start=x0)
    exact, _ = principal_pivoting(a, b, x0, scale=np.full(len(x0), std), tolerance=1e-11)
    assert np.count_nonzero(exact == 0.0) > 100
    np.testing.assert_allclose(x, exact, atol=1e-4 * exact.max())


@pytest.mark.parametrize("seed", range(8))
def test_the_line_search_of_the_dual_finds_its_minimum(seed):
    rng = np.random.default_rng(seed)
    p, q, y, d, b = (rng.standard_normal(n) for n in (30, 30, 8, 8, 8))

    def dual(t):
        return 0.5 * np.sum((y + t * d) ** 2) - b @ (y + t * d) + 0.5 * np.sum(np.maximum(p + t * q, 0.0) ** 2)

    t = _line_search(p, q, y, d, b)
    best = optimize.minimize_scalar(dual, bounds=(0.0, 100.0), method="bounded", options={"xatol": 1e-10})
    assert t >= 0.0 and dual(t) <= best.fun + 1e-9 * (1.0 + abs(best.fun))


def test_no_unknown_and_no_reading():
    assert len(projected_cg(sparse.csr_matrix((3, 0)), np.ones(3), np.zeros(0), start=np.zeros(0))[0]) == 0
    np.testing.assert_allclose(projected_cg(sparse.csr_matrix((0, 2)), np.zeros(0), np.array([1.0, -1.0]),
                                            start=np.zeros(2))[0], [1.0, 0.0], atol=1e-7)


def test_dense_contact_forces_of_ten_thousand_particles():
    _, touches, w = dense_forces(0.003, (0.09, 0.07), touches=20, frames=8, noise=0.002)
    z = np.concatenate([t.force.ravel() for t in touches])
    result = map_estimate(w, z, noise_std=0.002, prior_mean=0.0, prior_var=200.0**2)
    assert result.kkt_residual < 1e-3
    # The optimality conditions in the units of the problem: no free stiffness wants to move, no held one wants to rise.
    gradient = w.T @ (w @ result.mean - z) / 0.002**2 + result.mean / 200.0**2
    size = np.linalg.norm(w.T @ z) / 0.002**2
    assert np.linalg.norm(gradient[result.mean > 0]) < 1e-5 * size
    assert np.linalg.norm(np.minimum(gradient[result.mean == 0], 0)) < 1e-5 * size
    assert np.linalg.norm(w @ result.mean - z) < 0.6 * np.linalg.norm(z)
