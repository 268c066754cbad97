"""The level of a learned prior, and the standard deviations of its predicted readings, from objects that it was not
learned on: in cases with a closed form."""

import numpy as np
import pytest
from scipy import sparse

from vsfsim.vsf.meta.calibration import Held, Level, Missed, Width, blended, pattern_scale
from vsfsim.vsf.meta.composition import GaussianPrior


def held(rng, scale=1.0, *, weights=(0.7, 0.5, 0.2), m=40):
    answers = rng.uniform(0, 1, (m, 3))
    return Held(scale * answers @ weights, scale * answers)


def test_a_blend_that_explains_all_objects_is_found_and_leaves_no_spread():
    rng = np.random.default_rng(0)
    level = Level.of([held(rng, scale) for scale in (1.0, 30.0, 1e-3)])
    assert (level.network, level.pattern, level.naive) == pytest.approx((0.7, 0.5, 0.2)) and level.std < 1e-12


def test_a_network_that_knows_nothing_loses_its_weight_to_the_naive_prior():
    rng = np.random.default_rng(1)
    objects = []
    for _ in range(9):
        naive = rng.uniform(0, 1, 200)
        objects.append(Held(naive, np.stack([rng.uniform(0, 5, 200), rng.uniform(0, 1, 200), naive], axis=1)))
    level = Level.of(objects)
    assert level.naive == pytest.approx(1.0)
    assert (level.network, level.pattern) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_networks_that_know_where_and_not_how_much_keep_their_pattern():
    rng = np.random.default_rng(2)
    objects = []
    for _ in range(9):
        # The network's level is wrong by up to a factor of five either way, its pattern is right.
        shape = rng.uniform(0, 1, 100)
        objects.append(Held(shape, np.stack([rng.choice([0.2, 5.0]) * shape, shape, np.full(100, 0.5)], axis=1)))
    level = Level.of(objects)
    assert level.pattern == pytest.approx(1.0) and level.std < 1e-9
    near = np.array([True, True, False])
    assert pattern_scale(np.array([1.0, 3.0, 50.0]), near, 20.0) == pytest.approx(10.0)
    assert pattern_scale(np.array([0.0, 0.0, 5.0]), near, 20.0) == 1.0


def test_objects_count_alike_whatever_their_forces():
    # Half of the objects are ten times as stiff in all: absolute residuals would follow the stiff ones to 2.0.
    one, network = np.ones(5), np.stack([np.ones(5), np.zeros(5), np.zeros(5)], axis=1)
    level = Level.of([Held(10.0 * 2.0 * one, 10.0 * network), Held(1.0 * one, network)])
    # |2 - a|^2 / 2^2 + |1 - a|^2 / 1^2 is least at a = (1 / 2 + 1) / (1 / 4 + 1)
    assert level.network == pytest.approx(1.2)
    assert level.std == pytest.approx(np.sqrt(((2.0 / 1.2 - 1.0) ** 2 + (1.0 / 1.2 - 1.0) ** 2) / 2.0))


def plain(mean, var):
    return GaussianPrior(np.array(mean), np.array(var), sparse.csr_matrix((len(mean), 0)), np.zeros(0), np.zeros(0))


def test_several_networks_are_a_mixture_and_the_level_scales_it():
    priors = [plain([1.0, 4.0], [1.0, 2.0]), plain([3.0, 4.0], [3.0, 4.0])]
    near = np.array([True, False])
    out = blended(priors, Level(), near, naive_mean=10.0, naive_var=5.0)
    np.testing.assert_allclose(out.mean, [2.0, 4.0])
    np.testing.assert_allclose(out.var, [2.0 + 1.0, 3.0])
    assert out.membership.shape == (2, 0)
    # Patterns: 10, 40 with variances 100, 200, and 10, 40/3 with 100/3, 400/9.
    out = blended(priors, Level(0.0, 1.0, 0.0), near, naive_mean=10.0, naive_var=5.0)
    np.testing.assert_allclose(out.mean, [10.0, 80.0 / 3.0])
    np.testing.assert_allclose(out.var, [200.0 / 3.0, 1100.0 / 9.0 + (40.0 / 3.0) ** 2])
    out = blended(priors, Level(0.5, 0.0, 0.1, 0.3), near, naive_mean=10.0, naive_var=5.0)
    np.testing.assert_allclose(out.total_mean(), [2.0, 3.0])
    np.testing.assert_allclose(out.var, (0.25 * 3.0 + 0.01 * 5.0) / 0.36)
    np.testing.assert_allclose(out.total_std() ** 2, out.var + 0.3**2 * np.array([2.0, 3.0]) ** 2)


def signs(m):
    return np.where(np.arange(m) % 2, 1.0, -1.0)


def test_frames_that_move_no_particle_have_a_width_of_their_own():
    moved = np.repeat([0.0, 1e-9], 40)
    width = Width.of([Missed(np.where(moved, 2.0, 0.1) * signs(80), np.zeros(80), moved)])
    assert width.free == pytest.approx(0.1, rel=1e-3)
    np.testing.assert_allclose(width.std(np.zeros(80), moved), np.where(moved, 2.0, 0.1), rtol=1e-3)


def test_objects_count_alike_whatever_their_number_of_readings():
    # With one variance v for all, the mean over objects of log v + e^2 / v is least at the mean of their e^2.
    width = Width.of([Missed(1.0 * signs(600), np.zeros(600), np.zeros(600)),
                      Missed(3.0 * signs(6), np.zeros(6), np.zeros(6))])
    assert width.free == pytest.approx(np.sqrt((1.0 + 9.0) / 2.0), rel=1e-4)


@pytest.mark.parametrize("true", [Width(0.1, 0.0, 0.0, 3.0), Width(0.3, 2.0, 0.3, 1.5)])
def test_the_factors_behind_errors_are_found(true):
    # Over twenty seeds the standard deviations differ by up to 2.2 %.
    rng = np.random.default_rng(5)
    objects = []
    for _ in range(8):
        moved = rng.integers(0, 2, 2000)
        predicted, springs = moved * rng.uniform(0.0, 8.0, 2000), moved * rng.uniform(0.1, 1.0, 2000)
        objects.append(Missed(true.std(predicted, springs) * rng.standard_normal(2000), predicted, springs))
    found = Width.of(objects)
    for predicted, springs in ((0.0, 0.0), (1.0, 0.5), (2.0, 0.2), (7.0, 0.9)):
        assert found.std(np.array(predicted), np.array(springs)) == pytest.approx(
            float(true.std(np.array(predicted), np.array(springs))), rel=0.05)
