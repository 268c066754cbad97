"""What neighbours share: the likelihood, its hyper-parameters and the exact update, beside dense forms."""

import numpy as np
import pytest
from scipy import optimize, sparse, stats

from vsfsim.core.errors import VsfError
from vsfsim.vsf.meta.composition import GaussianPrior
from vsfsim.vsf.meta.spatial import Felt, Places, Smoothed, Spatial, _Parts

TRUE = Spatial(common=0.6, near=0.5, reach=0.04, touch=0.1, noise=0.05)
TOUCH = np.repeat(np.arange(20), 3)


def dense(places, prior, spatial):
    """Covariance of all springs (n, n)."""
    at = places.centres[places.member]
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)
    shared = spatial.common**2 + spatial.near**2 * np.exp(-0.5 * (apart / spatial.reach) ** 2)
    return np.outer(prior.mean, prior.mean) * shared


def felt(seed, particles=250, touches=20):
    """An object whose springs are drawn from the process, and presses on balls of its particles."""
    rng = np.random.default_rng(seed)
    x = np.stack([*rng.uniform(0.0, 0.2, (2, particles)), np.zeros(particles)], axis=1)
    prior = GaussianPrior.plain(rng.uniform(5.0, 15.0, particles), 0.3**2, particles)
    places = Places.of(x)
    springs = rng.multivariate_normal(prior.mean, dense(places, prior, TRUE))
    rows = []
    for centre in x[rng.choice(particles, touches, replace=False)]:
        near = np.maximum(1.0 - np.linalg.norm(x - centre, axis=1) / 0.025, 0.0)
        rows += [depth * near for depth in (0.002, 0.006, 0.01)]
    w = sparse.csr_matrix(np.array(rows))
    missed = (w @ prior.mean) * (TRUE.touch * rng.standard_normal(touches))[TOUCH]
    return Felt(w @ springs + missed + TRUE.noise * rng.standard_normal(60), w, TOUCH, places, prior), springs


def noise_of(one, rows):
    said = one.rows[rows] @ one.prior.mean
    return TRUE.touch**2 * np.outer(said, said) * (TOUCH[rows, None] == TOUCH[rows]) + TRUE.noise**2 * np.eye(len(said))


def test_the_likelihood_is_that_of_the_dense_gaussian_and_has_its_slope():
    one, _ = felt(0)
    logs = np.log([TRUE.common, TRUE.near, TRUE.reach, TRUE.touch, TRUE.noise])
    value, slope = _Parts.of(one).misfit(logs, 1.0)
    table = one.rows @ dense(one.places, one.prior, TRUE) @ one.rows.T.toarray() + noise_of(one, np.arange(60))
    known = stats.multivariate_normal(one.rows @ one.prior.mean, table).logpdf(one.readings)
    assert 60 * value == pytest.approx(-known - 30 * np.log(2.0 * np.pi), rel=1e-9)
    numeric = optimize.approx_fprime(logs, lambda x: _Parts.of(one).misfit(x, 1.0)[0], 1e-6)
    np.testing.assert_allclose(slope, numeric, rtol=1e-3, atol=1e-5)


def test_an_update_is_that_of_the_dense_gaussian():
    one, springs = felt(1)
    some, rest = one.rows[:30], one.rows[30:]
    found = Smoothed.after(TRUE, one.prior, one.places, some, one.readings[:30], TOUCH[:30])
    table = dense(one.places, one.prior, TRUE)
    gain = table @ some.T.toarray() @ np.linalg.inv(some @ table @ some.T.toarray() + noise_of(one, np.arange(30)))
    np.testing.assert_allclose(found.mean, one.prior.mean + gain @ (one.readings[:30] - some @ one.prior.mean),
                               rtol=1e-8, atol=1e-10)
    left = table - gain @ some.toarray() @ table
    np.testing.assert_allclose(found.spring_std(), np.sqrt(np.diag(left)), rtol=1e-6)
    np.testing.assert_allclose(found.reading_std(rest), np.sqrt(np.diag(rest @ left @ rest.T.toarray()) + (
        TRUE.touch * (rest @ one.prior.mean)) ** 2), rtol=1e-6)
    before = Smoothed.after(TRUE, one.prior, one.places, some[:0], one.readings[:0], TOUCH[:0])
    assert (before.mean == one.prior.mean).all()
    errors = [np.linalg.norm(rest @ (k.mean - springs)) for k in (before, found)]
    assert errors[1] < 0.7 * errors[0], "ten touches say something of ten others"


def test_training_objects_tell_the_reach_and_the_noise():
    """Ten objects tell them to factors of 1.5 and 1.2."""
    found = Spatial.of([felt(seed)[0] for seed in range(10)])
    assert 1 / 1.5 < found.reach / TRUE.reach < 1.5 and 1 / 1.2 < found.noise / TRUE.noise < 1.2
    assert 1 / 1.6 < found.near / TRUE.near < 1.6 and 1 / 1.8 < found.common / TRUE.common < 1.8


def test_objects_without_a_force_are_refused():
    one, _ = felt(2)
    with pytest.raises(VsfError, match="no training object has readings"):
        Spatial.of([Felt(0.0 * one.readings, one.rows, TOUCH, one.places, one.prior)])
    with pytest.raises(VsfError, match="no training object has readings"):
        Spatial.of([])
