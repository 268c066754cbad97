"""Particles bounded to what can be matter, and the noise in proportion to a touch's force, in every particle method."""

from __future__ import annotations

import inspect
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from vsfsim.baselines.gaussian import GaussianAverage, GaussianZero
from vsfsim.baselines.particle_model import ParticleModel, VsfSettings
from vsfsim.baselines.point_vsf import DenseVsf, PointVsf
from vsfsim.baselines.posterior import Posterior
from vsfsim.baselines.sbml import Sbml
from vsfsim.bench.check import MOCK_TASK
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View
from vsfsim.vsf.meta.composition import GaussianPrior

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


def test_a_sample_of_the_particles_stands_for_all_of_them(twig):
    whole = ParticleModel.behind(twig, VsfSettings(**SETTINGS))
    few = ParticleModel.behind(twig, VsfSettings(**SETTINGS, max_particles=100))
    assert len(few.particles) == 100 < len(whole.particles)
    assert {tuple(p) for p in few.particles} <= {tuple(p) for p in whole.particles}
    assert few.cell * 100 == pytest.approx(whole.cell * len(whole.particles)) and whole.cell == pytest.approx(5e-3**3)
    many = ParticleModel.behind(twig, VsfSettings(**SETTINGS, max_particles=10**6))
    np.testing.assert_array_equal(many.particles, whole.particles)
    with pytest.raises(MethodError, match="max_particles is -1"):
        VsfSettings(**SETTINGS, max_particles=-1)


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
        assert np.mean(untouched._std() ** 2) == pytest.approx(100.0**2, rel=1e-6)
    weights = model.knots()
    assert weights is model.knots() and weights.shape[1] < 0.1 * len(model.particles)
    assert np.asarray(weights.sum(axis=1)).ravel() == pytest.approx(1.0) and weights.data.min() > 0.0
    with pytest.raises(MethodError, match="reach is -1"):
        VsfSettings(**SETTINGS, reach=-1.0)
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


@pytest.mark.parametrize("method", [GaussianAverage, GaussianZero, PointVsf, DenseVsf, Sbml])
def test_every_particle_method_takes_both_and_refuses_what_is_none(method):
    assert {"noise_share", "band"} <= set(inspect.signature(method).parameters)
    made = method(noise_share=0.5, band=0.015)
    assert (made.shelf.settings.noise_share, made.shelf.settings.band) == (0.5, 0.015)
    with pytest.raises(MethodError, match="band is -1"):
        method(band=-1.0)


def test_the_stiffness_at_a_point_is_the_mean_of_the_particles_within_two_spacings():
    """Three particles 4, 8 and 30 mm from a point, 5 mm apart by their settings; and far from all, the nearest one."""
    model = SimpleNamespace(settings=SimpleNamespace(spacing=0.005, noise_std=1.0), cell=1e-6,
                            particles=np.array([[0.004, 0.0, 0.0], [0.0, 0.008, 0.0], [0.0, 0.0, 0.03]]))
    found = Posterior(model, np.array([1.0, 3.0, 7.0]), sparse.csr_matrix((0, 3)),
                      GaussianPrior.plain(0.0, 4.0, 3)).density(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]]))
    np.testing.assert_allclose(found.mean, [2e6, 7e6])
    np.testing.assert_allclose(found.std, [2e6, 2e6])
