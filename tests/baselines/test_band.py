"""Particles bounded to what can be matter, and the noise in proportion to a touch's force, in every particle method."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from vsfsim.baselines.particle_model import ParticleModel, VsfSettings
from vsfsim.baselines.point_vsf import PointVsf
from vsfsim.baselines.posterior import Posterior
from vsfsim.bench.check import MOCK_TASK
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View

SETTINGS = {"spacing": 0.005, "friction": 0.0, "noise_std": 1.0, "margin": 0.01, "table_height": 0.0, "device": "cpu"}


@pytest.fixture
def twig():
    """An upright twig of 10 mm, seen from the side at 1 m by a camera 0.25 m above the table."""
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = [0.0, -1.0, 0.25]
    depth = np.zeros((100, 100), np.float32)
    depth[10:90, 48:53] = 1.0
    return View(np.full((100, 100, 3), 80, np.uint8), depth, depth > 0.0,
                np.array([[500.0, 0.0, 49.5], [0.0, 500.0, 49.5], [0.0, 0.0, 1.0]]), pose)


def test_a_band_leaves_out_the_air_behind_a_twig(twig):
    tilted = twig.camera_pose.copy()
    tilted[:3, 3] += [0.0, 0.0, 0.3]
    turn = 0.3
    tilted[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, -np.sin(turn), np.cos(turn)],
                               [0.0, -np.cos(turn), -np.sin(turn)]])
    from_above = View(twig.rgb, twig.depth, twig.mask, twig.intrinsics, tilted)
    whole = ParticleModel.behind(from_above, VsfSettings(**SETTINGS)).particles
    band = ParticleModel.behind(from_above, VsfSettings(**SETTINGS, band=0.012)).particles
    away = np.linalg.norm(band[:, None] - from_above.points()[None], axis=2).min(axis=1)
    assert 0 < len(band) < len(whole) and away.max() <= 0.012
    assert {tuple(p) for p in band} <= {tuple(p) for p in whole}
    with pytest.raises(MethodError, match="or a wider band"):
        ParticleModel.behind(from_above, VsfSettings(**SETTINGS, band=1e-7))


def test_springs_that_are_alike_are_means_of_knots_and_a_touch_tells_of_those_beside_it(twig, monkeypatch):
    """A field of 20 N/m, of which a touch reads the lower half of the twig: independent springs above stay at 0."""
    found = {}
    for reach in (0.0, 0.05):
        model = ParticleModel.behind(twig, VsfSettings(**SETTINGS, reach=reach))
        low = (model.particles[:, 2] < np.median(model.particles[:, 2])).astype(float)
        rows = sparse.csr_matrix(sparse.diags_array(low))
        monkeypatch.setattr(model, "stack", lambda _, rows=rows, low=low: (rows, 20.0 * low))
        found[reach] = Posterior.of(model, [], prior_mean=0.0, prior_var=100.0**2)
        height = model.particles[:, 2] - np.median(model.particles[:, 2])
        beside, far = (height > 0.0) & (height < 0.02), height > 0.3
        near = found[reach].stiffness
        assert near[height < -0.05] == pytest.approx(20.0, abs=0.1)
        assert beside.any() and np.abs(near[beside] - (20.0 if reach else 0.0)).max() < 4.0
        assert not far.any() or np.abs(near[far]).max() < 1e-6
        # what is not touched has the prior's standard deviation, in the mean over particles
        untouched = Posterior(model, near, found[reach].rows[:0], found[reach].prior)
        std = untouched._reading_std(sparse.identity(len(near), format="csr"))
        assert np.mean(std**2) == pytest.approx(100.0**2, rel=1e-6)
    weights = model.knots(0.05)
    assert weights is model.knots(0.05) and weights.shape[1] < 0.1 * len(model.particles)
    assert np.asarray(weights.sum(axis=1)).ravel() == pytest.approx(1.0) and weights.data.min() > 0.0
    with pytest.raises(MethodError, match="estimator 'filter', whose springs are independent"):
        PointVsf(estimator="filter", reach=0.05)


def test_a_reading_grows_with_a_power_of_the_summed_displacement():
    """Of equal springs; of others it is their mean, weighted by the displacements, times that."""
    view, readings = mock_view(0).view, record(mock_view(0), parse_task(MOCK_TASK, "mock")).readings
    whole, half = (ParticleModel.behind(view, VsfSettings(**SETTINGS, growth=g)).observe(readings[0].action).toarray()
                   for g in (1.0, 0.5))
    total = whole.sum(axis=1)
    assert total.max() > 0.0
    np.testing.assert_allclose(half.sum(axis=1), np.sqrt(total), rtol=1e-12)
    springs = np.random.default_rng(0).uniform(1.0, 5.0, whole.shape[1])
    at = total.argmax()
    assert half[at] @ springs == pytest.approx((whole[at] @ springs) / total[at] * np.sqrt(total[at]))
    for growth in (0.0, 1.5):
        with pytest.raises(MethodError, match=f"growth is {growth}"):
            VsfSettings(**SETTINGS, growth=growth)


def test_the_noise_of_a_prediction_is_in_proportion_to_the_largest_force_of_its_touch():
    readings = record(mock_view(0), parse_task(MOCK_TASK, "mock")).readings
    model = ParticleModel.behind(mock_view(0).view, VsfSettings(**{**SETTINGS, "noise_std": 0.5}, noise_share=0.3))
    known = Posterior.of(model, [], prior_mean=50.0, prior_var=1e-9)  # nothing left open but the noise
    actions = [reading.action for reading in readings]
    for force, std in zip(known.predict(actions), known.predict_std(actions), strict=True):
        assert std == pytest.approx(np.hypot(0.5, 0.3 * np.abs(force).max()), rel=1e-3)
    assert max(np.abs(force).max() for force in known.predict(actions)) > 1.0
