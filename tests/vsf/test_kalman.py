"""The diagonal Kalman filter against its literal dense form, and in cases with a closed form."""

import numpy as np
import pytest
from scipy import sparse

from vsfsim.vsf.estimate.kalman import DiagonalFilter


def literal(mean, var, w, z, noise):
    """The filter as the papers write it, on dense matrices."""
    v = np.diag(var)
    gain = v @ w.T @ np.linalg.inv(w @ v @ w.T + np.diag(noise**2))
    return np.maximum(mean + gain @ (z - w @ mean), 0.0), np.diag((np.eye(len(mean)) - gain @ w) @ v)


@pytest.mark.parametrize("m, n, fill", [(1, 30, 1.0), (7, 30, 0.5), (30, 7, 1.0), (60, 40, 0.05), (40, 60, 0.05),
                                        (12, 12, 1.0)])
def test_frames_are_those_of_the_literal_filter(m, n, fill):
    rng = np.random.default_rng(m)
    mean, var = rng.uniform(0, 100, n), rng.uniform(1, 1e4, n)
    ours = DiagonalFilter.start(n, mean=mean, var=var)
    for _ in range(5):
        w = rng.uniform(-0.01, 0.02, (m, n)) * (rng.uniform(size=(m, n)) < fill)
        z, noise = rng.normal(1, 1, m), rng.uniform(0.1, 0.3, m)
        ours.update(sparse.csr_matrix(w), z, noise_std=noise)
        mean, var = literal(mean, var, w, z, noise)
        np.testing.assert_allclose(ours.mean, mean, atol=1e-9 * np.abs(mean).max())
        np.testing.assert_allclose(ours.var, var, rtol=1e-7)


def test_a_replayed_frame_moves_the_means_and_not_the_variances():
    rng = np.random.default_rng(3)
    w, z, noise = rng.uniform(0.0, 0.02, (4, 9)), rng.normal(1, 1, 4), np.full(4, 0.2)
    ours = DiagonalFilter.start(9, mean=50.0, var=400.0)
    ours.update(sparse.csr_matrix(w), z, noise_std=noise)
    mean, var = ours.mean.copy(), ours.var.copy()
    ours.update(sparse.csr_matrix(w), z, noise_std=noise, replayed=True)
    np.testing.assert_allclose(ours.mean, literal(mean, var, w, z, noise)[0], rtol=1e-9)
    np.testing.assert_array_equal(ours.var, var)


def test_replay_repairs_what_later_frames_undid():
    # Frames that share particles: each update drops correlations, and so forgets a part of the frames before it.
    left = []
    for replay in (0, 10):
        rng = np.random.default_rng(5)
        w = rng.uniform(0.0, 0.02, (40, 20))
        z = w @ rng.uniform(0.0, 100.0, 20)
        ours = DiagonalFilter.start(20, mean=0.0, var=1e4)
        for start in (0, 20):
            ours.run(sparse.csr_matrix(w[start:start + 20]), z[start:start + 20], noise_std=0.01, replay=replay)
        left.append((np.linalg.norm(w @ ours.mean - z) / np.linalg.norm(z), ours.var.copy()))
    # over ten seeds the misfit falls to 0.06 to 0.32 of that without replay
    assert left[1][0] < 0.5 * left[0][0]
    np.testing.assert_array_equal(left[0][1], left[1][1])


def test_particles_that_no_frame_moves_keep_their_prior_and_springs_never_push():
    ours = DiagonalFilter.start(3, mean=5.0, var=100.0)
    ours.update(sparse.csr_matrix([[0.01, 0.0, 0.0]]), np.array([-4.0]), noise_std=0.01)
    assert ours.mean.tolist() == [0.0, 5.0, 5.0] and ours.var[1] == 100.0 and 0.0 < ours.var[0] < 100.0
