"""Metrics and observations against numbers worked out by hand."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import spearmanr

from vsfsim.bench.metrics import (
    Answer,
    can_be_scored,
    mask_scores,
    record_scores,
    spearman,
    touch_errors,
)
from vsfsim.bench.observations import OBSERVATIONS, observation
from vsfsim.bench.protocol import record


def test_reading_metrics_by_hand():
    a = touch_errors(np.array([[1.0], [2.0], [9.0]]), np.array([[0.0], [0.0], [np.nan]]), np.array([True, True, False]))
    b = touch_errors(np.array([[3.0]]), np.array([[0.0]]), np.array([True]))
    assert a == {"n": 2, "sse": 5.0}
    assert record_scores(Answer.READINGS, [a, b])["rmse"] == pytest.approx((2.5**0.5 + 3.0) / 2)


def test_spearman_agrees_with_scipy_with_ties_and_rounding_does_not_move_ranks():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 6, 40).astype(float), rng.normal(size=40)
    assert spearman(a, b) == pytest.approx(spearmanr(a, b).statistic)
    assert spearman(np.ones(5), np.arange(5.0)) == 0.0
    # a prior gives half of the points one value; another machine rounds them otherwise
    estimate, truth = np.where(np.arange(40) < 20, 3.0, rng.uniform(1.0, 9.0, 40)), rng.uniform(size=40)
    rounded = estimate * (1.0 + 1e-14 * rng.standard_normal(40))
    assert spearman(rounded, truth) == spearman(estimate, truth)


def test_stiffness_scores_allow_any_scale():
    truth = np.array([1.0, 10.0, 100.0, 1000.0, 1000.0])
    assert record_scores(Answer.STIFFNESS, [{"mean": 3.7 * truth, "truth": truth}]) == {
        "stiffness_spearman": pytest.approx(1.0)}
    assert not can_be_scored(np.zeros(5), truth) and not can_be_scored(np.ones(2), np.ones(2))
    assert can_be_scored(np.array([0.0, 0.0, 1.0]), np.ones(3))


def test_the_f1_of_a_mask_is_the_best_there_is():
    stiff = np.array([True, False, False, True, False])
    # Thresholds 9: precision 1, recall 1/2; 5: two of three found right -> F1 4/5.
    assert mask_scores(np.array([9.0, 1.0, 5.0, 5.0, 0.0]), stiff) == pytest.approx((0.8, 1.0))
    assert mask_scores(np.ones(5), stiff)[0] == pytest.approx(2 * 2 / 7)
    assert mask_scores(np.ones(3), np.zeros(3, bool)) == (0.0, 0.0)


def test_observations_by_hand():
    force, axis = np.array([[0.0, 3.0, 4.0], [0.0, 0.0, -1.0]]), np.array([0.0, 0.0, -1.0])
    assert observation("normal-force", "x").reading(force, axis).tolist() == [[4.0], [-1.0]]
    assert observation("force-magnitude", "x").reading(force, axis).tolist() == [[5.0], [1.0]]


def test_rows_times_the_true_stiffness_are_the_readings(task, toy_views):
    view, row = toy_views[1], OBSERVATIONS["normal-force"]
    recording = record(view, dataclasses.replace(task, observation=row))
    for reading, clean in zip(recording.readings, recording.clean, strict=True):
        rows = row.predictor()(view.truth.vsf_points, reading.action, friction=0.0, device="cpu")
        np.testing.assert_allclose((rows @ view.truth.vsf_stiffness).reshape(clean.shape), clean, atol=1e-9)
