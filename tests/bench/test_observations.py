"""The table of observations: its rows by hand, and the proof that a new one is one row and one function."""

import dataclasses

import numpy as np

from vsfsim.bench.observations import OBSERVATIONS, observation
from vsfsim.bench.protocol import record


def test_readings_by_hand():
    force, axis = np.array([[0.0, 3.0, 4.0], [0.0, 0.0, -1.0]]), np.array([0.0, 0.0, -1.0])
    assert observation("normal-force", "x").reading(force, axis).tolist() == [[4.0], [-1.0]]
    assert observation("force-magnitude", "x").reading(force, axis).tolist() == [[5.0], [1.0]]


def test_rows_times_the_true_stiffness_are_the_readings(task, toy_views):
    view, row = toy_views[1], OBSERVATIONS["normal-force"]
    recording = record(view, dataclasses.replace(task, observation=row))
    for reading, clean in zip(recording.readings, recording.clean, strict=True):
        rows = row.predictor()(view.truth.vsf_points, reading.action, friction=0.0, device="cpu")
        np.testing.assert_allclose((rows @ view.truth.vsf_stiffness).reshape(clean.shape), clean, atol=1e-9)
