"""Projected conjugate gradients against exact solvers."""

import numpy as np
import pytest
from palpation import layer_with_inclusion, palpate
from scipy import optimize, sparse

from vsfsim.vsf.estimate.map import projected_cg
from vsfsim.vsf.estimate.pivoting import principal_pivoting
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.sticking import stick

FIELD = layer_with_inclusion()


@pytest.mark.parametrize("m, n, strength", [(20, 8, 1.0), (8, 20, 1.0), (60, 40, 30.0), (40, 60, 100.0)])
def test_it_finds_the_minimiser(m, n, strength):
    rng = np.random.default_rng(m)
    a = strength * rng.normal(size=(m, n)) * (rng.uniform(size=(m, n)) < 0.4)
    b, x0 = strength * rng.normal(size=m), rng.normal(size=n)
    x, _ = projected_cg(sparse.csr_matrix(a), b, x0, start=x0, tolerance=1e-12)
    expected, _ = optimize.nnls(np.concatenate([a, np.eye(n)]), np.concatenate([b, x0]), maxiter=10_000)
    assert 0 < np.count_nonzero(expected == 0.0) < n
    np.testing.assert_allclose(x, expected, atol=1e-8 * max(1.0, np.abs(expected).max()))


def test_no_unknown_and_no_reading():
    assert len(projected_cg(sparse.csr_matrix((3, 0)), np.ones(3), np.zeros(0), start=np.zeros(0))[0]) == 0
    np.testing.assert_allclose(projected_cg(sparse.csr_matrix((0, 2)), np.zeros(0), np.array([1.0, -1.0]),
                                            start=np.zeros(2))[0], [1.0, 0.0], atol=1e-7)


def test_it_agrees_with_principal_pivoting_on_dense_forces():
    noise, mean, std, spacing = 0.05, 20.0, 30.0, 0.00363
    axes = [np.arange(-h + 0.5 * spacing, end, spacing) for h, end in ((0.08, 0.08), (0.06, 0.06), (0.015, 0.0))]
    particles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    w = sparse.vstack([dense_force_rows(stick(particles, t.vertices, t.triangles), len(particles), t.triangles,
                                        t.vertices.shape[1])
                       for t in palpate(FIELD, touches=15, frames=8, extent=(0.12, 0.08), substeps=1)]).tocsr()
    z = w @ (FIELD(particles) * spacing**3) + noise * np.random.default_rng(1).standard_normal(w.shape[0])
    a = sparse.csr_matrix(w[:, np.unique(w.indices)]) * (std / noise)
    b, x0 = z / noise, np.full(a.shape[1], mean / std)
    x, _ = projected_cg(a, b, x0, start=x0)
    exact, _ = principal_pivoting(a, b, x0, scale=np.full(len(x0), std), tolerance=1e-11)
    assert np.count_nonzero(exact == 0.0) > 100
    np.testing.assert_allclose(x, exact, atol=1e-4 * exact.max())
