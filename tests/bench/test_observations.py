"""The table of observations: its rows by hand, and the proof that a new one is one row and one function."""

import dataclasses

import numpy as np
import pytest
from scipy import sparse

from vsfsim.baselines.gaussian import GaussianAverage
from vsfsim.baselines.point_vsf import PointVsf
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.mock import SPACING, mock_view
from vsfsim.bench.noise import stream
from vsfsim.bench.observations import OBSERVATIONS, Channel, Observation, observation
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import TaskError
from vsfsim.vsf.dynamics import simulate


def test_readings_by_hand():
    force, axis = np.array([[0.0, 3.0, 4.0], [0.0, 0.0, -1.0]]), np.array([0.0, 0.0, -1.0])
    assert observation("normal-force", "x").reading(force, axis).tolist() == [[4.0], [-1.0]]
    assert observation("force-magnitude", "x").reading(force, axis).tolist() == [[5.0], [1.0]]
    with pytest.raises(TaskError, match="Did you mean 'normal-force'"):
        observation("normal_force", "x")


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_every_row_names_a_function(name):
    assert OBSERVATIONS[name].name == name and callable(OBSERVATIONS[name].predictor())


def test_a_row_whose_function_is_missing_is_refused():
    row = dataclasses.replace(OBSERVATIONS["pressure"], rows="vsfsim.vsf.observations:presure")
    with pytest.raises(TaskError, match=r"observation 'pressure': its rows .* cannot be loaded"):
        row.predictor()


# All that a new observation takes: a force plate under the object, three numbers a frame, with noise of its own.


def plate_rows(particles, motion, *, friction, device):
    """W (3 T, n) [m] of the force on the plate, which is that on the probe: -K u of every displaced particle."""
    moved = simulate(particles, motion.probe, motion.poses, friction=friction, device=device)
    frame = np.repeat(np.arange(moved.frames), np.diff(moved.pointer))
    row, column = 3 * frame[:, None] + np.arange(3), np.broadcast_to(moved.particle[:, None], (len(frame), 3))
    return sparse.csr_matrix((-moved.displacement.ravel(), (row.ravel(), column.ravel())),
                             shape=(3 * moved.frames, len(particles)))


def plate_noise(values, time, force, noise, **touch):
    return values + 0.05 * stream(noise, *touch.values(), 9).standard_normal(values.shape)


PLATE = Observation("plate-force", "N", 3, Channel("reaction", "any scene", lambda touch: touch.reaction, plate_noise),
                    lambda force, axis: force, f"{__name__}:plate_rows", "Force of the object on a plate under it.")


@pytest.mark.parametrize("row", [PLATE, OBSERVATIONS["normal-force"]], ids=lambda row: row.name)
def test_rows_times_the_true_stiffness_are_the_readings(task, toy_views, row):
    view = toy_views[1]
    recording = record(view, dataclasses.replace(task, observation=row))
    for reading, clean in zip(recording.readings, recording.clean, strict=True):
        rows = row.predictor()(view.truth.vsf_points, reading.action, friction=0.0, device="cpu")
        np.testing.assert_allclose((rows @ view.truth.vsf_stiffness).reshape(clean.shape), clean, atol=1e-9)


@pytest.fixture
def plate_task(task_text, monkeypatch):
    monkeypatch.setitem(OBSERVATIONS, PLATE.name, PLATE)
    return parse_task(task_text.replace('kind = "normal-force"', 'kind = "plate-force"'), "toy-v1.toml")


def test_a_new_observation_is_read_with_its_own_noise(plate_task, toy_views):
    recording = record(toy_views[1], plate_task)
    for touch, reading, clean in zip(toy_views[1].touches, recording.readings, recording.clean, strict=True):
        assert np.array_equal(clean, touch.reaction) and reading.value.shape == (len(touch.time), 3)
    error = np.concatenate([r.value - c for r, c in zip(recording.readings, recording.clean)])
    assert error.std() == pytest.approx(0.05, rel=4.5 / np.sqrt(2 * error.size))


@pytest.fixture(scope="module")
def thirty_touches(write_dataset):
    return write_dataset([mock_view(i, split="train" if i < 1 else "test", touches=30) for i in range(3)])


class KnowsPlates:
    """The new row is in the table of every process of the method, as that of a package that brings its own row is."""

    def meta_fit(self, specimens):
        OBSERVATIONS.setdefault(PLATE.name, PLATE)
        super().meta_fit(specimens)

    def adapt(self, view, support):
        OBSERVATIONS.setdefault(PLATE.name, PLATE)
        super().adapt(view, support)


class PlateGaussian(KnowsPlates, GaussianAverage):
    """Of the average."""


class PlatePoint(KnowsPlates, PointVsf):
    """Of the papers' particles."""


@pytest.mark.parametrize("method", ["PlateGaussian", "PlatePoint"])
def test_methods_predict_a_new_observation(plate_task, thirty_touches, method):
    task = dataclasses.replace(plate_task, dataset=dataclasses.replace(plate_task.dataset, touches=30))
    result = evaluate(f"{__name__}:{method}", task, thirty_touches, seeds=1, check=False)
    assert result.unit == "N" and result.observation == "plate-force"
    # The mock object obeys the particle model, but a query touch also meets particles that no support touch displaced:
    # few, with 26 touches of support. Over nine seeds of the mock objects the ratio is 0.11 to 0.26 with a standard
    # deviation of 0.05, and the coverage 0.90 to 0.98 with 0.025. With 8 touches of support the ratio was up to 0.84.
    assert result.scores["rmse_ratio"]["all"].mean < 0.35, "of predicting nothing"
    assert result.scores["coverage90"]["all"].mean > 0.85


def test_the_mock_object_has_the_modulus_of_its_springs():
    """A spring on a grid stands for E times the spacing."""
    truth = mock_view(0).truth
    np.testing.assert_allclose(truth.young_modulus * SPACING, truth.vsf_stiffness, rtol=1e-12)
