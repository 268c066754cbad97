"""The standard errors by which methods are told apart, against closed forms."""

import math
from types import SimpleNamespace

import pytest

from vsfsim.bench.board.compare import by_object, interval, paired


def test_a_standard_error_over_objects_has_n_minus_one_and_a_value_is_of_its_shot_alone():
    """Of 1, 2, 6: mean 3, sum of squares about it 14, standard error sqrt(14 / 2 / 3)."""
    values = {"a": 1.0, "b": 2.0, "c": 6.0}
    assert interval(values) == pytest.approx((3.0, math.sqrt(14.0 / 6.0)))
    found = paired({name: v + 1.0 for name, v in values.items()}, dict.fromkeys(values, 1.0))
    assert (found.mean, found.error, found.objects) == (pytest.approx(3.0), pytest.approx(math.sqrt(14.0 / 6.0)), 3)
    assert math.isnan(paired({"a": 1.0}, {"a": 0.0}).error)
    # a mean over the runs of one shot; other shots, and runs without an answer, do not enter the scores that rank
    columns = {"object": ["a-v0", "a-v0", "a-v1", "a-v0", "b-v0"], "shot": ["5", "5", "5", "all", "5"],
               "mask_f1": [0.2, None, 0.4, 0.9, None]}
    result = SimpleNamespace(values={}, answers={"mask": columns})
    assert by_object(result, "mask_f1", "5") == {"a": pytest.approx(0.3)}
    assert by_object(result, "mask_f1", "all") == {"a": 0.9} and by_object(result, "mask_f1", "0") == {}
