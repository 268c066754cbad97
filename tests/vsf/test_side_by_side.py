"""`vsfsim bench methods`: the literal forms give the same answers, and what would not fit is not tried."""

import pytest

from vsfsim.vsf import side_by_side
from vsfsim.vsf.dynamics import VsfError


def test_equal_answers():
    load = side_by_side.Workload.of(150, 3, 4)
    for ours, theirs in ((side_by_side.epoch, side_by_side.epoch_literal), (side_by_side.batch, side_by_side.batch_literal),
                         (side_by_side.batch_dense, side_by_side.batch_dense_literal), (side_by_side.online, side_by_side.online_literal)):
        (seconds, answer), (_, expected) = ours(load), theirs(load)
        assert seconds > 0.0 and answer.shape == expected.shape and abs(answer - expected).max() < 1e-8 * abs(expected).max(), ours.__name__


def test_what_does_not_fit_is_said(monkeypatch):
    monkeypatch.setattr(side_by_side, "MOST_BYTES", 1.0)
    monkeypatch.setattr(side_by_side, "_apart", lambda work, load: (0.5, 10.0, None))
    rows = side_by_side.compare(60, 2, 3)
    assert all(row.literal_seconds is None and row.reason.startswith("needs") for row in rows)
    assert "needs 0 GB" in side_by_side.table(rows) and "0.500" in side_by_side.table(rows)


def test_refusals():
    with pytest.raises(VsfError, match="at least 1, 1 and 2"):
        side_by_side.Workload.of(100, 0, 3)
