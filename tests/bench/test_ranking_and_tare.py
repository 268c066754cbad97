"""The standard error by which methods are told apart, and the force that a task shows, against closed forms."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from vsfsim.bench.board.compare import interval, paired
from vsfsim.bench.noise import noisy_force
from vsfsim.bench.task import parse_task

WHICH = {"object_index": 3, "view_index": 1, "touch_index": 7}


def test_a_standard_error_over_objects_has_n_minus_one():
    """Of 1, 2, 6: mean 3, sum of squares about it 14, standard error sqrt(14 / 2 / 3)."""
    values = {"a": 1.0, "b": 2.0, "c": 6.0}
    assert interval(values) == pytest.approx((3.0, math.sqrt(14.0 / 6.0)))
    found = paired({name: v + 1.0 for name, v in values.items()}, dict.fromkeys(values, 1.0))
    assert (found.mean, found.error, found.objects) == (pytest.approx(3.0), pytest.approx(math.sqrt(14.0 / 6.0)), 3)
    assert math.isnan(paired({"a": 1.0}, {"a": 0.0}).error)


def noise(**given):
    text = (Path(__file__).parent / "conftest.py").read_text().split('TASK = """')[1].split('"""')[0]
    return dataclasses.replace(parse_task(text, "toy-v1.toml").noise, **given)


def touch():
    """Five frames in free air, then a push along z to 5 N."""
    force = np.zeros((25, 3))
    force[5:, 2] = np.linspace(0.25, 5.0, 20)
    return force


def test_the_tare_takes_the_offset_away_and_no_more():
    """Without white noise and drift a tared force is the true one, whatever the offset; without a tare it is off by the
    offset, the same in all frames."""
    quiet = {"force_std": 0.0, "drift_std": 0.0, "offset_std": 2.0}
    assert noisy_force(touch(), noise(**quiet, tare_frames=3), **WHICH) == pytest.approx(touch(), abs=1e-12)
    off = noisy_force(touch(), noise(**quiet, tare_frames=0), **WHICH) - touch()
    assert np.abs(off).max() > 0.1 and off == pytest.approx(np.tile(off[0], (25, 1)), abs=1e-12)


def test_the_tare_is_the_mean_of_the_frames_before_contact():
    """As many as there are: of five free frames a tare of nine takes five, of a touch that begins in contact none."""
    white = {"force_std": 0.3, "drift_std": 0.0, "offset_std": 2.0}
    raw = noisy_force(touch(), noise(**white, tare_frames=0), **WHICH)
    for wanted, taken in ((1, 1), (3, 3), (5, 5), (9, 5)):
        found = noisy_force(touch(), noise(**white, tare_frames=wanted), **WHICH)
        assert found == pytest.approx(raw - raw[:taken].mean(axis=0), abs=1e-12), wanted
    pressed = touch()[5:]
    assert noisy_force(pressed, noise(**white, tare_frames=3), **WHICH) == pytest.approx(
        noisy_force(pressed, noise(**white, tare_frames=0), **WHICH))


def test_the_white_noise_has_the_stated_spread_and_the_drift_ends_at_its_own():
    force = np.zeros((4000, 3))
    found = noisy_force(force, noise(force_std=0.3, drift_std=0.0, offset_std=0.0, tare_frames=0), **WHICH)
    assert found.std() == pytest.approx(0.3, rel=0.03) and abs(found.mean()) < 0.02
    ends = np.array([noisy_force(force[:20], noise(force_std=0.0, drift_std=0.5, offset_std=0.0, tare_frames=1),
                                 object_index=k, view_index=0, touch_index=0)[[0, 10, -1]] for k in range(400)])
    assert np.abs(ends[:, 0]).max() == 0.0 and ends[:, 2].std() == pytest.approx(0.5, rel=0.08)
    assert ends[:, 1] == pytest.approx(ends[:, 2] * 10.0 / 19.0)
