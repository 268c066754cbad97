"""Projected conjugate gradients against exact solvers, and on the size of dense contact forces."""

import numpy as np
import pytest
from scipy import optimize, sparse

from measurements.palpation import layer_with_inclusion, palpate
from measurements.workload import MEAN, NOISE, STD, Workload
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.estimate.pivoting import _line_search, principal_pivoting
from vsfsim.vsf.estimate.projected_cg import projected_cg
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.sticking import stick


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
    load = Workload.of(6000, 15, 8)
    touched = np.unique(load.dense.indices)
    a = sparse.csr_matrix(load.dense[:, touched]) * (STD / NOISE)
    b, x0 = load.dense_z / NOISE, np.full(len(touched), MEAN / STD)
    x, _ = projected_cg(a, b, x0, start=x0)
    exact, _ = principal_pivoting(a, b, x0, scale=np.full(len(x0), STD), tolerance=1e-11)
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
    touches = palpate(layer_with_inclusion(), touches=20, frames=8, extent=(0.12, 0.08), noise=0.002)
    axes = [np.arange(-0.09, 0.09, 0.003), np.arange(-0.07, 0.07, 0.003), np.arange(-0.0145, 0.0, 0.003)]
    particles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    rows = [dense_force_rows(stick(particles, t.vertices, t.triangles), len(particles), t.triangles,
                             t.vertices.shape[1]) for t in touches]
    w, z = sparse.vstack(rows).tocsr(), np.concatenate([t.force.ravel() for t in touches])
    result = map_estimate(w, z, noise_std=0.002, prior_mean=0.0, prior_var=200.0**2)
    assert result.kkt_residual < 1e-3
    # The optimality conditions in the units of the problem: no free stiffness wants to move, no held one wants to rise.
    gradient = w.T @ (w @ result.mean - z) / 0.002**2 + result.mean / 200.0**2
    size = np.linalg.norm(w.T @ z) / 0.002**2
    assert np.linalg.norm(gradient[result.mean > 0]) < 1e-5 * size
    assert np.linalg.norm(np.minimum(gradient[result.mean == 0], 0)) < 1e-5 * size
    assert np.linalg.norm(w @ result.mean - z) < 0.6 * np.linalg.norm(z)
