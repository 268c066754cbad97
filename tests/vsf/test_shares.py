"""What springs share is found on objects that were drawn with it."""

import numpy as np
import pytest
from scipy import sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.meta.calibration import Felt, Shares
from vsfsim.vsf.meta.composition import GaussianPrior

PARTICLES, KNOTS, READINGS, UNIT = 60, 6, 40, 10.0
TRUE = Shares(springs=1.5, common=0.8, near=0.5, noise=0.3)


def drawn(rng):
    """W, z, a prior and B of an object whose springs were drawn by `TRUE`."""
    places, centres = np.linspace(0.0, 1.0, PARTICLES), np.linspace(0.0, 1.0, KNOTS)
    knots = np.exp(-0.5 * ((places[:, None] - centres) / 0.15) ** 2)
    knots = sparse.csr_matrix(knots / knots.sum(axis=1, keepdims=True))
    prior = GaussianPrior.plain(rng.uniform(5.0, 20.0, PARTICLES), rng.uniform(4.0, 9.0, PARTICLES), PARTICLES)
    rows = sparse.csr_matrix(np.where(rng.random((READINGS, PARTICLES)) < 0.1, rng.random((READINGS, PARTICLES)), 0.0))
    springs = prior.mean + TRUE.springs * np.sqrt(prior.var) * rng.standard_normal(PARTICLES)
    springs += UNIT * (TRUE.common * rng.standard_normal() + TRUE.near * (knots @ rng.standard_normal(KNOTS)))
    return rows, rows @ springs + TRUE.noise * rng.standard_normal(READINGS), prior, knots


def test_shares_are_those_with_which_the_objects_were_drawn():
    """Over five seeds of forty objects each is within a factor of 1.6."""
    rng = np.random.default_rng(0)
    found = Shares.of([Felt.of(*drawn(rng), UNIT) for _ in range(40)])
    for name in ("springs", "common", "near", "noise"):
        assert 1 / 1.7 < getattr(found, name) / getattr(TRUE, name) < 1.7, (name, found)


def test_the_prior_is_the_one_whose_likelihood_was_maximised():
    rng = np.random.default_rng(1)
    rows, z, prior, knots = drawn(rng)
    felt, shared = Felt.of(rows, z, prior, knots, UNIT), TRUE.prior(prior, knots, UNIT)
    covariance = np.diag(shared.var) + shared.membership @ np.diag(shared.group_var) @ shared.membership.T
    np.testing.assert_allclose(np.tensordot([TRUE.springs**2, TRUE.common**2, TRUE.near**2], felt.parts, 1),
                               rows @ covariance @ rows.T, atol=1e-9)
    np.testing.assert_allclose(shared.total_mean(), prior.mean)


def test_touches_that_met_nothing_are_refused():
    rows, z, prior, knots = drawn(np.random.default_rng(2))
    with pytest.raises(VsfError, match="no training object has readings"):
        Shares.of([Felt.of(0.0 * rows, z, prior, knots, UNIT)])
