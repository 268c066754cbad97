"""`fem-map-seen`: a solid from the view, and the simulator's moduli fitted to touches of it."""

import dataclasses

import numpy as np
import pytest

from vsfsim.baselines.fem.seen import FemMapSeen
from vsfsim.baselines.fem.seen_solid import seen_solid
from vsfsim.bench.check import check
from vsfsim.bench.mock import BLOCK, mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import load_task
from vsfsim.core.errors import MethodError


def test_the_solid_is_what_the_view_shows():
    view = mock_view(0).view
    solid = seen_solid(view, 0.014)
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    # a block from above: its four sides are seen as edges of its top at most
    np.testing.assert_allclose(high - low, BLOCK, atol=0.006)
    assert solid.volume() == pytest.approx(np.prod(BLOCK), rel=0.2)


def test_a_view_without_a_solid_is_refused():
    view = mock_view(0).view
    with pytest.raises(MethodError, match="mask is empty"):
        seen_solid(dataclasses.replace(view, mask=np.zeros_like(view.mask)), 0.014)
    one = np.zeros_like(view.mask)
    one[np.nonzero(view.mask)[0][0], np.nonzero(view.mask)[1][0]] = True
    with pytest.raises(MethodError, match="lie on a line"):
        seen_solid(dataclasses.replace(view, mask=one), 0.014)


@pytest.mark.slow
def test_touches_tell_the_moduli(tmp_path):
    method = FemMapSeen(objects=1, presses=2, size=0.02, steps=3)
    with pytest.raises(MethodError, match="learned nothing yet"):
        method.adapt(mock_view(0).view, [])
    view, task = mock_view(1), load_task("fewshot-shoes-v3-mini-v1")
    method.meta_fit([specimen(mock_view(0, split="train", touches=3), task)])
    recording = record(view, task)
    asked, true = recording.queries[1].action, recording.clean[1]

    def error(support):
        method.adapt(view.view, support)
        return float(np.sqrt(np.mean((method.predict([asked])[0] - true) ** 2) / np.mean(true**2)))

    assert error(recording.readings[:1]) < 0.6
    method.save(tmp_path)
    other = FemMapSeen(size=0.02)
    other.load(tmp_path)
    other.adapt(view.view, [])
    found = other.stiffness(np.array([[0.0, 0.0, 0.03]]))
    assert found.mean[0] > 0.0 and found.std[0] > 0.0 and other.predict([]) == []


@pytest.mark.slow
def test_what_was_fitted_before_decides_no_bit():
    findings = check("fem-map-seen", parameters={"steps": 1}, brief=True)
    assert [(one.clause, one.detail) for one in findings if one.outcome == "failed"] == []
