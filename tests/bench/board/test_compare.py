"""The standard errors by which methods are told apart, against closed forms."""

import math

import pytest

from vsfsim.bench.board.compare import interval, paired


def test_a_standard_error_over_objects_has_n_minus_one():
    """Of 1, 2, 6: mean 3, sum of squares about it 14, standard error sqrt(14 / 2 / 3)."""
    values = {"a": 1.0, "b": 2.0, "c": 6.0}
    assert interval(values) == pytest.approx((3.0, math.sqrt(14.0 / 6.0)))
    found = paired({name: v + 1.0 for name, v in values.items()}, dict.fromkeys(values, 1.0))
    assert (found.mean, found.error, found.objects) == (pytest.approx(3.0), pytest.approx(math.sqrt(14.0 / 6.0)), 3)
    assert math.isnan(paired({"a": 1.0}, {"a": 0.0}).error)
