"""Two datasets that should be the same: touches are equal to the bit, close, or other."""

import dataclasses

import numpy as np
import pytest
from mock_dataset import write

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError
from vsfsim.data.verify import CLOSE, compare, difference


@pytest.fixture(scope="module")
def touch():
    one = mock_view(0, touches=1).touches[0]
    return dataclasses.replace(one, force=np.tile([0.0, 0.0, 2.0], (len(one.time), 1)))


def test_a_difference_is_a_share_of_the_largest_force_of_the_frames_that_converged(touch):
    force = touch.force.copy()
    force[3] += [0.003, 0.0, 0.004]
    assert difference(touch, dataclasses.replace(touch, force=force)) == pytest.approx(0.0025)
    marked = touch.converged.copy()
    marked[3] = False
    one, other = (dataclasses.replace(touch, converged=marked, force=f) for f in (touch.force, force))
    assert difference(one, other) == 0.0


def test_other_frames_or_marks_and_a_force_out_of_nothing_are_other(touch):
    silent = dataclasses.replace(touch, force=np.zeros_like(touch.force))
    assert difference(silent, silent) == 0.0 and difference(silent, touch) == np.inf
    marked = touch.converged.copy()
    marked[0] = ~marked[0]
    assert difference(touch, dataclasses.replace(touch, converged=marked)) == np.inf
    assert difference(touch, dataclasses.replace(touch, force=touch.force[:-1])) == np.inf
    assert 0.0 < CLOSE < 0.0025


def test_datasets_of_two_devices_are_compared_and_those_of_two_recipes_are_not(tmp_path):
    view = mock_view(0, split="test", touches=2)
    for name, device, tier in (("cpu", "cpu", "linear"), ("gpu", "cuda", "linear"), ("other", "cpu", "fem")):
        write(tmp_path / name, [view], device=device, tier=tier)
    assert compare(tmp_path / "cpu", tmp_path / "gpu").equal == 2
    with pytest.raises(DatasetError, match="different recipes: tier 'linear' there, 'fem' asked for"):
        compare(tmp_path / "cpu", tmp_path / "other")
