"""`vsfsim bench methods`: the literal forms give the same answers, and what would not fit is not tried."""

import numpy as np
import pytest

from vsfsim.vsf import side_by_side
from vsfsim.vsf.dynamics import VsfError


def test_equal_answers():
    load = side_by_side.Workload.of(150, 3, 4)
    for ours, theirs in ((side_by_side.epoch, side_by_side.epoch_literal), (side_by_side.batch, side_by_side.batch_literal),
                         (side_by_side.batch_dense, side_by_side.batch_dense_literal), (side_by_side.online, side_by_side.online_literal)):
        (seconds, answer), (_, expected) = ours(load), theirs(load)
        assert seconds > 0.0 and answer.shape == expected.shape and abs(answer - expected).max() < 1e-8 * abs(expected).max(), ours.__name__


def test_what_does_not_fit_is_measured_on_fewer_touches_and_said(monkeypatch):
    load = side_by_side.Workload.of(60, 8, 3)
    monkeypatch.setattr(side_by_side, "MOST_BYTES", side_by_side.ESTIMATORS[2].cost(load.first(3))[0])
    asked = []
    monkeypatch.setattr(side_by_side, "_apart", lambda work, part, device: (asked.append((work.__name__, part.touches)), (0.5, 10.0, np.ones(3)))[1])
    rows = side_by_side.compare(60, 8, 3)
    small = rows[2]
    assert small.part == 2
    assert small.literal_whole > small.literal_seconds and small.difference == 0.0
    assert ("batch_dense", 8) in asked and ("batch_dense_literal", 8) not in asked
    told = side_by_side.table(rows, 8)
    assert f"the first {small.part} touches" in told and "needs 0.0 GB and about" in told
    alone = side_by_side.compare(60, 8, 3, literal=False)
    assert all(row.part == 0 for row in alone) and "literal form not run" in side_by_side.table(alone, 8)


def test_a_part_is_the_first_touches():
    load = side_by_side.Workload.of(150, 3, 4)
    part = load.first(2)
    assert part.touches == 2 and part.pressure.shape[0] == 8 and part.dense.shape[0] == 8 * load.frame and part.touch.tolist() == [0] * 4 + [1] * 4


def test_refusals():
    with pytest.raises(VsfError, match="at least 1, 1 and 2"):
        side_by_side.Workload.of(100, 0, 3)
