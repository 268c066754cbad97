"""The standard deviations of predicted readings, from objects that a prior was not learned on: closed forms."""

import numpy as np
import pytest

from vsfsim.vsf.meta.calibration import Missed, Width


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
