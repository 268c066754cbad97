"""Composition structures, and eq. 16 under them against an independent non-negative least squares solver."""

import numpy as np
import pytest
from scipy import optimize, sparse

from vsfsim.vsf.estimate.structured import reading_std, structured_map
from vsfsim.vsf.meta.composition import Composition, GaussianPrior, segment


def blobs(seed=0):
    rng = np.random.default_rng(seed)
    centres = rng.normal(0, 4, (3, 6))
    label = rng.integers(3, size=600)
    return centres[label] + rng.normal(0, 0.4, (600, 6)), label


def test_segments_are_the_clusters_and_repeat():
    features, label = blobs()
    found = segment(features, 3, seed=0)
    assert all(len(np.unique(found[label == k])) == 1 for k in range(3)) and found.max() == 2
    np.testing.assert_array_equal(found, segment(features, 3, seed=0))


@pytest.mark.parametrize("features", [np.zeros((5, 4)), np.ones((1, 3)), np.repeat(np.eye(3), 2, axis=0)])
def test_fewer_kinds_of_particle_than_segments(features):
    found = segment(features, 10)
    assert found.shape == (len(features),) and found.max() < len(np.unique(features, axis=0))


def test_structures_are_zero_one_matrices_whose_components_average_their_features():
    features, _ = blobs()
    for structure, count in (("HE", 0), ("HE+HO", 1), ("HE+SEG", 10)):
        part = Composition.of(structure, features)
        assert part.membership.shape == (600, count) and part.features.shape == (count, 6)
        if count:
            assert set(part.membership.data) == {1.0} and (np.asarray(part.membership.sum(axis=1)) == 1.0).all()
            first = part.membership[:, [0]].toarray()[:, 0] > 0
            np.testing.assert_allclose(part.features[0], features[first].mean(axis=0))


def test_std_where_only_shared_components_vary_is_the_limit_of_little_variance_of_their_own():
    rng = np.random.default_rng(4)
    w = sparse.csr_matrix(rng.uniform(0.0, 0.1, (30, 40)) * (rng.uniform(size=(30, 40)) < 0.3))
    query = sparse.csr_matrix(rng.uniform(0.0, 0.1, (9, 40)))
    g = sparse.csr_matrix(rng.uniform(0.0, 1.0, (40, 5)))
    def prior(own):
        return GaussianPrior(np.zeros(40), np.full(40, own), g, np.zeros(5), np.array([1.0, 4.0, 9.0, 1.0, 2.0]))
    for rows in (np.eye(40), query):
        none, little = (reading_std(w, rows, noise_std=0.3, prior=prior(v)) for v in (0.0, 1e-9))
        assert none == pytest.approx(little, rel=1e-5) and (none > 0.0).all()


@pytest.mark.parametrize("m, n, s", [(12, 20, 0), (12, 20, 1), (30, 8, 2), (5, 30, 10)])
def test_map_and_std_are_those_of_the_dense_program(m, n, s):
    rng = np.random.default_rng(m)
    w = rng.uniform(0, 0.02, (m, n)) * (rng.uniform(size=(m, n)) < 0.3)
    z, noise = rng.normal(0.5, 1, m), rng.uniform(0.1, 0.5, m)
    g = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(n) % max(s, 1))), shape=(n, max(s, 1)))[:, :s]
    prior = GaussianPrior(rng.uniform(-20, 60, n), rng.uniform(1, 1e3, n), sparse.csr_matrix(g),
                          rng.uniform(-10, 50, s), rng.uniform(1, 1e3, s))
    result = structured_map(sparse.csr_matrix(w), z, noise_std=noise, prior=prior)
    covariance = np.diag(prior.var) + (g.toarray() * prior.group_var) @ g.toarray().T
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    # Lawson and Hanson's active set on the stacked least squares problem: exact, and it shares no line with ours.
    expected, _ = optimize.nnls(np.concatenate([w / noise[:, None], root]),
                                np.concatenate([z / noise, root @ prior.total_mean()]), maxiter=10_000)
    assert 0 < np.count_nonzero(expected == 0.0) < n
    np.testing.assert_allclose(result, expected, atol=1e-9 * expected.max())
    std = reading_std(sparse.csr_matrix(w), np.eye(n), noise_std=noise, prior=prior)
    np.testing.assert_allclose(std, np.sqrt(np.diag(np.linalg.inv(np.linalg.inv(covariance) + (w.T / noise**2) @ w))),
                               rtol=1e-9)
    query = rng.normal(size=(7, n))
    posterior = np.linalg.inv(np.linalg.inv(covariance) + (w.T / noise**2) @ w)
    std = reading_std(sparse.csr_matrix(w), sparse.csr_matrix(query), noise_std=noise, prior=prior)
    np.testing.assert_allclose(std, np.sqrt(np.einsum("ij,jk,ik->i", query, posterior, query)), rtol=1e-8)
    np.testing.assert_allclose(reading_std(sparse.csr_matrix((0, n)), sparse.csr_matrix(query), noise_std=noise[:0],
                                           prior=prior), np.sqrt(np.einsum("ij,jk,ik->i", query, covariance, query)))
