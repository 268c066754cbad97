"""Sums in a fixed order, and numbers without their last bits."""

import numpy as np

from vsfsim.core.system.exact import BITS, inverse3, length, product, snapped


def test_small_products_and_inverses_are_those_of_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((50, 4, 3)), rng.standard_normal((50, 3, 5))
    assert np.abs(product(a, b) - a @ b).max() < 1e-14
    assert np.abs(product(a[0], b[0]) - a[0] @ b[0]).max() < 1e-14
    m = rng.standard_normal((200, 3, 3))
    good = np.abs(np.linalg.det(m)) > 0.1
    assert np.abs(product(inverse3(m[good]), m[good]) - np.eye(3)).max() < 1e-12
    np.testing.assert_allclose(inverse3(m[good]), np.linalg.inv(m[good]), rtol=1e-9, atol=1e-12)
    assert not np.isfinite(inverse3(np.zeros((3, 3)))).any()
    assert length(a[0, 0]) == np.float64(sum(x * x for x in a[0, 0].tolist())) ** 0.5


def test_numbers_that_differ_in_their_last_bits_are_snapped_to_one():
    rng = np.random.default_rng(1)
    values = rng.lognormal(0.0, 10.0, 100_000) * rng.choice([-1.0, 1.0], 100_000)
    near = values * (1.0 + 4e-16 * rng.integers(-3, 4, values.shape))
    assert (snapped(values) != snapped(near)).sum() <= 3, "once in a million values"
    assert np.abs(snapped(values) / values - 1.0).max() <= 2.0**-BITS
    kept = np.array([0.0, 1.0, -0.5, 3.0, 2.0**-40, np.inf])
    assert np.array_equal(snapped(kept), kept) and np.array_equal(snapped(snapped(values)), snapped(values))
    assert np.isnan(snapped(np.array([np.nan]))).all()
