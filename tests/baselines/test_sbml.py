"""SBML on the mock object: it conforms, its features carry stiffness over to objects never touched, and it refuses
clearly."""


import numpy as np
import pytest
from mock_methods import TASK, error, training

from vsfsim.baselines.sbml import Sbml
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.core.errors import VsfsimError

FAST = {"rate": 1e-2, "epochs": 50, "patience": 25, "noise_std": 0.15, "noise_share": 0.1}
"""Particles on another grid than the mock object's err by a share of the force. With ``noise_share`` 0 touches are
trusted beyond that, and 13 of them raise the error up to 1.6 times."""
TEST = range(10, 16)
"""Objects that no prior was trained on."""


@pytest.fixture(scope="module")
def train():
    return training(7, touches=14)


@pytest.fixture(scope="module")
def fitted(train):
    method = Sbml(**FAST)
    method.meta_fit(train)
    return method


def error_of(method, support, index=10):
    return error(method, mock_view(index, touches=20), support, range(14, 20))


def in_half(method, k, index):
    """Share of the readings in contact that lie in the central 50 % of what is predicted after k touches."""
    view = mock_view(index, touches=20)
    recording = record(view, TASK)
    method.adapt(view.view, recording.readings[:k])
    actions = [recording.readings[i].action for i in range(14, 20)]
    answer, std = (np.concatenate(given) for given in (method.predict(actions), method.predict_std(actions)))
    half = 0.6745 * std  # of the central 50 %
    inside = np.abs(np.concatenate(recording.clean[14:20]) - answer) <= half
    return inside[answer > 0.0].mean()


def test_features_predict_the_stiff_half_before_any_touch(fitted):
    for index in TEST:
        view = mock_view(index)
        fitted.adapt(view.view, [])
        points = view.truth.probe_points
        inner = points[np.abs(points[:, :2]).max(axis=1) < 0.02]
        mean = fitted.stiffness(inner).mean
        # the darker half is five times as stiff on every training object; over four seeds the least is 3.44
        assert mean[inner[:, 0] > 0].mean() > 2.0 * mean[inner[:, 0] < 0].mean()


def test_touches_reduce_the_error_and_the_std(fitted):
    before, after = (np.array([error_of(fitted, range(k), index) for index in TEST]) for k in (0, 13))
    # the geometric mean over objects is 0.48 to 0.51 over four seeds
    assert np.exp(np.mean(np.log(after / before))) < 0.8
    point = np.array([[0.0, 0.0, 0.028]])
    for index in TEST:
        view = mock_view(index, touches=20)
        recording = record(view, TASK)
        std = []
        for k in (0, 13):
            fitted.adapt(view.view, recording.readings[:k])
            std.append(fitted.stiffness(point).std[0])
        assert std[1] < std[0]


def test_several_networks_find_the_level_that_no_picture_shows(train, tmp_path):
    # The level of a mock object is between half and twice that of the others. One touch tells it, but only a component
    # common to all particles carries it to what was not touched.
    quick = {**FAST, "rate": 1e-2, "epochs": 12, "patience": 12}
    several = Sbml(**quick, networks=3)
    several.meta_fit(train[:6])
    errors = np.array([[error_of(several, range(k), index) for k in (0, 1)] for index in TEST])
    assert several._level.std > 0.1 and several._level.network > several._level.naive
    # over eight seeds of objects and training the ratio of the mean errors is 0.32 to 0.75; of one network 0.83 to 0.98
    assert np.exp(np.log(errors[:, 1] / errors[:, 0]).mean()) < 0.8, errors
    # The intervals of readings in contact: over eight seeds 0.47 to 0.66 lie in the central 50 %, and 0.65 to 0.86 by
    # the noise of the settings.
    assert 0.35 < np.mean([in_half(several, k, index) for k in (1, 5) for index in TEST]) < 0.76
    several.save(tmp_path)
    other = Sbml(**FAST, networks=3, prior=str(tmp_path))
    other.meta_fit([])
    assert error_of(other, range(2)) == error_of(several, range(2))
    assert other._width == several._width
    with pytest.raises(VsfsimError, match="learned with networks '3', not '1'"):
        Sbml(prior=str(tmp_path)).meta_fit([])


@pytest.mark.parametrize(("networks", "parts"), [(1, 1), (3, 3), (9, 6)])
def test_views_of_one_object_are_learned_from_or_held_out_together(networks, parts):
    names = [f"plants-{k:04d}" for k in range(6) for _ in range(4)]
    held = Sbml(networks=networks)._held_out(names)
    assert len(held) == parts
    for part in held:
        assert {names[i] for i in part}.isdisjoint(names[i] for i in range(24) if i not in part)


def test_what_a_gpu_learns_is_what_the_host_learns(train, device):
    if device == "cpu":
        pytest.skip("the host alone learns here")
    found = []
    for where in ("cpu", device):
        method = Sbml(**{**FAST, "epochs": 5}, dropout=0.0, device=where)  # dropout draws on the device
        method.meta_fit(train)
        found.append((method.training[0].train, error_of(method, range(3))))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=1e-4)
    assert found[1][1] == pytest.approx(found[0][1], rel=1e-3)


def test_a_saved_prior_is_used_instead_of_learning(fitted, tmp_path):
    fitted.save(tmp_path)
    other = Sbml(**FAST, prior=str(tmp_path))
    other.meta_fit([])
    assert error_of(other, range(3)) == error_of(fitted, range(3))
    with pytest.raises(VsfsimError, match=r"learned with structure 'HE', not 'HE\+HO'.*--set structure=HE"):
        Sbml(structure="HE+HO", prior=str(tmp_path)).meta_fit([])
