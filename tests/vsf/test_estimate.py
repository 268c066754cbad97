"""The MAP quadratic program against brute force, and at the size it is for."""

import tracemalloc

import numpy as np
import pytest
from scipy import sparse
from scipy.optimize import lsq_linear, nnls

from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.estimate.pivoting import kkt_residual
from vsfsim.vsf.estimate.structured import reading_std
from vsfsim.vsf.meta.composition import GaussianPrior


def accuracy(k, w, z, noise, mean, var):
    """KKT residual of stiffnesses ``k``."""
    w = sparse.csr_matrix(w)
    noise, mean, var = (np.broadcast_to(v, w.shape[k]).astype(float) for v, k in ((noise, 0), (mean, 1), (var, 1)))
    a = sparse.csr_matrix(sparse.diags_array(1.0 / noise) @ w @ sparse.diags_array(np.sqrt(var)))
    return kkt_residual(a, z / noise, mean / np.sqrt(var), k / np.sqrt(var), np.sqrt(var))


def brute(w, z, noise, mean, var):
    """The stacked dense least-squares problem with bounds."""
    m, n = w.shape
    noise, mean, var = (np.broadcast_to(v, s).astype(float) for v, s in ((noise, m), (mean, n), (var, n)))
    # In x = K / sqrt(v), so that the reference, too, is well scaled.
    a = np.concatenate([w / noise[:, None] * np.sqrt(var), np.eye(n)])
    b = np.concatenate([z / noise, mean / np.sqrt(var)])
    one = lsq_linear(a, b, bounds=(0, np.inf), method="bvls", tol=1e-14, max_iter=1000).x
    two = nnls(a, b)[0]
    best = min((one, two), key=lambda x: np.sum((a @ x - b) ** 2))
    return best * np.sqrt(var), a, b


def cost(k, a, b, var):
    return np.sum((a @ (k / np.sqrt(var)) - b) ** 2)


@pytest.mark.parametrize("var", [1e-6, 1e4, 1e12])
@pytest.mark.parametrize("noise", [1e-4, 10.0])
@pytest.mark.parametrize("m, n", [(8, 25), (25, 8)])
def test_every_balance_of_prior_and_noise(var, noise, m, n):
    rng = np.random.default_rng(m)
    w = rng.uniform(0, 0.01, (m, n))
    truth = rng.lognormal(3, 1, n)
    z = w @ truth + 0.1 * rng.standard_normal(m)
    result = map_estimate(w, z, noise_std=noise, prior_mean=15.0, prior_var=var)
    expected, a, b = brute(w, z, noise, 15.0, var)
    assert accuracy(result, w, z, noise, 15.0, var) <= 1e-9
    # Both minimise the same convex function. Under a very weak prior K is badly determined, but its cost is not.
    ours, theirs = (cost(k, a, b, np.full(n, var)) for k in (result, expected))
    assert ours <= theirs * (1 + 1e-9)
    condition = 1 + np.linalg.norm(a, 2) ** 2
    np.testing.assert_allclose(result, expected, atol=max(1e-14 * condition, 1e-9) * max(expected.max(), 15.0))


def test_rank_deficient_rows_and_columns():
    rng = np.random.default_rng(7)
    w = np.repeat(rng.uniform(0, 0.01, (6, 12)), 3, axis=0)
    w = np.concatenate([w, w, np.zeros((18, 4))], axis=1)
    z = rng.uniform(0, 1, 18)
    result = map_estimate(w, z, noise_std=0.01, prior_mean=10.0, prior_var=1e5)
    expected, _, _ = brute(w, z, 0.01, 10.0, 1e5)
    assert accuracy(result, w, z, 0.01, 10.0, 1e5) <= 1e-9
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-6 * expected.max())
    # Identical columns have equal stiffness, and untouched particles keep their prior.
    np.testing.assert_allclose(result[:12], result[12:24], rtol=1e-9, atol=1e-9 * expected.max())
    np.testing.assert_array_equal(result[24:], 10.0)


def test_no_touch_gives_the_prior_clipped_at_zero():
    result = map_estimate(sparse.csr_matrix((5, 4)), np.ones(5), noise_std=1.0, prior_mean=np.array([1.0, -2, 3, 0]),
                          prior_var=1.0)
    np.testing.assert_array_equal(result, [1, 0, 3, 0])
    empty = map_estimate(sparse.csr_matrix((0, 3)), np.zeros(0), noise_std=1.0, prior_mean=2.0, prior_var=1.0)
    np.testing.assert_array_equal(empty, [2, 2, 2])


def test_one_particle_in_closed_form():
    # K = max(0, (mu/v + w z / s^2) / (1/v + w^2 / s^2))
    for z, expected in ((0.5, (10 / 4 + 0.02 * 0.5 / 0.01) / (1 / 4 + 4e-4 / 0.01)), (-3.0, 0.0)):
        result = map_estimate(np.array([[0.02]]), np.array([z]), noise_std=0.1, prior_mean=10.0, prior_var=4.0)
        assert result[0] == pytest.approx(expected, rel=1e-12)
    std = reading_std(sparse.csr_matrix([[0.02]]), np.eye(1), noise_std=0.1, prior=GaussianPrior.plain(10.0, 4.0, 1))
    assert std[0] == pytest.approx((1 / 4 + 4e-4 / 0.01) ** -0.5, rel=1e-12)


def presses(particles: int, touches: int, frames: int, seed: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Rows like a sphere's: a patch of neighbours moved by more and more, patches overlapping."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-0.15, -0.05, 0], [0.15, 0.05, 0.1], (particles, 3))
    rows = []
    for _ in range(touches):
        centre = rng.uniform([-0.13, -0.04, 0.09], [0.13, 0.04, 0.1])
        distance = np.linalg.norm(points - centre, axis=1)
        for depth in np.linspace(0.001, 0.02, frames):
            rows.append(sparse.csr_matrix(np.maximum(depth - 0.6 * distance, 0.0)))
    w = sparse.vstack(rows).tocsr()
    truth = np.where(points[:, 0] > 0, 200.0, 5.0) * rng.lognormal(0, 0.5, particles)
    return w, w @ truth + 0.15 * rng.standard_normal(w.shape[0])


def test_twenty_thousand_particles_and_nine_hundred_readings():
    w, z = presses(20_000, 75, 12, 0)
    tracemalloc.start()
    result = map_estimate(w, z, noise_std=0.15, prior_mean=50.0, prior_var=1e4)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert accuracy(result, w, z, 0.15, 50.0, 1e4) <= 1e-9
    # n x n alone would be 3.2 GB.
    assert peak < 200e6
    # The optimality conditions, written out once more in the units of the problem.
    gradient = w.T @ (w @ result - z) / 0.15**2 + (result - 50.0) / 1e4
    free = result > 0
    size = np.abs(w.T @ z).max() / 0.15**2
    assert np.abs(gradient[free]).max() <= 1e-9 * size and gradient[~free].min() >= -1e-9 * size
    assert 0 < (~free).sum()
