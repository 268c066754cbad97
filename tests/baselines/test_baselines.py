"""The baselines on the mock object, whose forces obey their model: they conform, they learn, and their prior is what it
claims."""

import dataclasses

import numpy as np
import pytest
from mock_methods import TASK, error, training

from vsfsim.baselines.gaussian import GaussianAverage, GaussianZero
from vsfsim.baselines.point_vsf import PointVsf
from vsfsim.bench.metrics import spearman
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.core.errors import MethodError


@pytest.fixture(scope="module")
def train():
    return training(2, touches=10)


@pytest.fixture(scope="module")
def subject():
    view = mock_view(5, touches=20)
    return view, record(view, TASK)


@pytest.mark.parametrize("method", [GaussianAverage, GaussianZero, PointVsf])
def test_touches_reduce_the_error(method, train, subject):
    fitted = method(noise_std=0.15)  # the mock is exactly of the model's kind: only the sensor errs
    fitted.meta_fit(train)
    errors = [error(fitted, subject[0], range(k), range(14, 20)) for k in (0, 3, 13)]
    # Thirteen touches cover the 4 cm square that is touched; the mock is exactly of the model's kind, on a shifted
    # grid.
    assert errors[2] < 0.25 * errors[0], errors
    assert errors[2] < errors[1], errors


def saved_prior(method, folder):
    method.save(folder)
    with np.load(folder / f"{method._name}.npz") as file:
        return {key: float(value) for key, value in file.items() if key != "units"}


def test_the_prior_is_the_spread_of_the_training_springs(train, tmp_path):
    average, zero = GaussianAverage(), GaussianZero()
    average.meta_fit(train)
    zero.meta_fit(train)
    prior = saved_prior(average, tmp_path)
    # The mock's springs lie between 60 x 0.5 x 0.8 and 300 x 2 x 1.2 N/m; the fit smears them but keeps the level.
    assert 24.0 < prior["mean"] < 720.0
    assert saved_prior(zero, tmp_path) == {"mean": 0.0, "variance": prior["variance"]}
    twice = GaussianAverage()
    twice.meta_fit([dataclasses.replace(s, touches=tuple(dataclasses.replace(r, value=2.0 * r.value)
                                                         for r in s.touches)) for s in train])
    doubled = saved_prior(twice, tmp_path)
    assert doubled["mean"] == pytest.approx(2.0 * prior["mean"], rel=0.05), "twice the force is twice the stiffness"


def test_stiffness_finds_the_stiff_half(train, subject):
    view, recording = subject
    method = PointVsf()
    method.adapt(view.view, list(recording.readings))
    points, truth = view.truth.probe_points, view.truth.probe_stiffness
    inner = np.abs(points[:, :2]).max(axis=1) < 0.02
    estimate = method.stiffness(points[inner])
    assert spearman(estimate.mean, truth[inner]) > 0.6
    # A density: the spring constant over the cell of a particle, here of the order of 100 N/m over (5 mm)^3.
    assert 1e8 < estimate.mean.max() < 1e10
    method.adapt(view.view, [])
    assert method.stiffness(points[inner]).std == pytest.approx(1000.0 / 0.005**3)
    assert (estimate.std < 1000.0 / 0.005**3).all()


def test_the_filter_takes_frames_one_by_one_and_one_frame_as_the_batch_does(subject):
    """After one frame there is nothing to forget: both estimators say the same."""
    view, recording = subject[0].view, subject[1]
    one = recording.readings[0]
    last = dataclasses.replace(one, valid=np.arange(len(one.valid)) == len(one.valid) - 1)
    batch, online = PointVsf(), PointVsf(estimator="filter")
    for method in (batch, online):
        method.adapt(view, [last])
    np.testing.assert_allclose(online.posterior.stiffness, batch.posterior.stiffness, rtol=1e-9, atol=1e-9)
    points = batch.posterior.model.particles[:50]
    np.testing.assert_allclose(online.stiffness(points).std, batch.stiffness(points).std, rtol=1e-6)
    for method in (batch, online):
        method.adapt(view, recording.readings[:4])
    # it forgets what a frame correlates
    assert np.abs(online.posterior.stiffness - batch.posterior.stiffness).max() > 0.0
    asked = recording.readings[5].action
    assert np.isfinite(online.predict([asked])[0]).all() and (online.predict_std([asked])[0] >= 1.0).all()
    broken = dataclasses.replace(one, value=np.full_like(one.value, np.nan))
    with pytest.raises(MethodError, match="touch 2 of the support"):
        online.adapt(view, [*recording.readings[1:3], broken])
