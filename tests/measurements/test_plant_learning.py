"""`vsfsim measure plant-learning`: the error over that of predicting zero, and paired differences of its variants."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from measurements.artificial_plants.learning import ALL, error_ratio, scaled_ratio, table


class Share:
    """A posterior that predicts a share of the truth of every touch, and nonsense in frames that are not scored."""

    def __init__(self, share):
        self.share = share

    def predict(self, actions):
        return [np.where(query.scored[:, None], self.share * query.clean, 1e6) for query in actions]


def test_the_ratio_is_one_for_zero_and_counts_scored_frames_of_all_touches_alike():
    rng = np.random.default_rng(0)
    queries = []
    for size in (0.1, 30.0):
        query = SimpleNamespace(clean=size * rng.normal(size=(9, 7)), scored=np.arange(9) < 6)
        query.action = query
        queries.append(query)
    mixed = [Share(0.0), Share(1.0)]  # wrong on the weak touch, right on the strong one
    assert 0.0 < error_ratio(mixed, queries) < 0.01
    for share, ratio in ((0.0, 1.0), (1.0, 0.0), (0.25, 0.75), (-1.0, 2.0)):
        assert error_ratio([Share(share)] * 2, queries) == pytest.approx(ratio, abs=1e-12)


def test_differences_are_paired_over_plants():
    found = [{ALL: 0.8, "other": 0.9}, {ALL: 0.6, "other": 0.7}, {ALL: 1.0, "other": 1.1}]
    base, other = table(found, {}).tables[0].rows
    assert (base["ratio"], base["change"], base["change_error"]) == (pytest.approx(0.8), 0.0, 0.0)
    assert base["error"] == pytest.approx(0.2 / np.sqrt(3))
    assert other["change"] == pytest.approx(0.1) and other["change_error"] == pytest.approx(0.0, abs=1e-12)
    assert other["error"] == pytest.approx(base["error"])


def test_the_best_factor_mends_size_and_not_direction():
    """A prediction half as large as the truth has one factor; with frames of wrong size each needs its own; one that
    points elsewhere is best multiplied by zero."""
    rng = np.random.default_rng(1)
    query = SimpleNamespace(clean=rng.normal(size=(9, 7)), scored=np.arange(9) < 6)
    query.action = query
    assert scaled_ratio(Share(0.5), [query], axis=None) == pytest.approx(0.0, abs=1e-9)
    uneven = Share(np.linspace(0.1, 2.0, 9)[:, None])
    whole, frames = (scaled_ratio(uneven, [query], axis=axis) for axis in (None, 1))
    assert whole > 0.2 and frames == pytest.approx(0.0, abs=1e-9)
    assert scaled_ratio(Share(-0.5), [query], axis=None) == pytest.approx(1.0, abs=1e-12)
