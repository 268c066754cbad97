"""`vsfsim measure methods`: the literal forms give the same answers, and what would not fit is not tried."""

import mmap

import numpy as np
import pytest

from measurements import estimators as side_by_side
from measurements.workload import Workload
from vsfsim.core.errors import VsfError
from vsfsim.core.system import process_memory


def test_equal_answers():
    load = Workload.of(150, 3, 4)
    for ours, theirs in ((side_by_side.epoch, side_by_side.epoch_literal),
                         (side_by_side.batch, side_by_side.batch_literal),
                         (side_by_side.batch_dense, side_by_side.batch_dense_literal),
                         (side_by_side.online, side_by_side.online_literal)):
        (taken, answer), (_, expected) = ours(load), theirs(load)
        assert taken.clock > 0.0 and taken.busy > 0.0 and answer.shape == expected.shape
        assert abs(answer - expected).max() < 1e-8 * abs(expected).max(), ours.__name__


def test_what_does_not_fit_is_measured_on_fewer_touches_and_said(monkeypatch):
    load = Workload.of(60, 8, 3)
    monkeypatch.setattr(side_by_side, "MOST_BYTES", side_by_side.ESTIMATORS[2].cost(load.first(3))[0])
    asked = []

    def in_no_time(work, part, device):
        asked.append((work.__name__, part.touches))
        return side_by_side.Times(0.5, 2.0 if "literal" in work.__name__ else 0.1), 10.0, np.ones(3)

    monkeypatch.setattr(side_by_side, "_apart", in_no_time)
    rows = side_by_side.compare(load)
    small = rows[2]
    assert small.part == 2
    assert small.literal_whole > small.literal.clock and small.difference == 0.0 and small.times == pytest.approx(20.0)
    assert ("batch_dense", 8) in asked and ("batch_dense_literal", 8) not in asked
    found = side_by_side.report({}, rows)
    assert [row["part"] for row in found.tables[1].rows][:3] == [8, 8, 2]
    assert found.record()["estimators"][2]["literal"]["busy"] == 2.0 and "literal CPU [s]" in found.text()
    alone = side_by_side.compare(load, literal=False)
    assert all(row.part == 0 for row in alone) and "literal CPU" not in side_by_side.report({}, alone).text()


def test_a_part_is_the_first_touches():
    load = Workload.of(150, 3, 4)
    part = load.first(2)
    assert (part.touches == 2 and part.pressure.shape[0] == 8 and part.dense.shape[0] == 8 * load.frame
            and part.touch.tolist() == [0] * 4 + [1] * 4)


def _pages(count):
    """``count`` doubles on pages of their own: malloc may answer from what earlier tests have freed, and a peak would
    not move."""
    out = np.frombuffer(mmap.mmap(-1, 8 * count), dtype=np.float64)
    out[:] = 1.0
    return out


def test_the_peak_is_that_of_the_work_alone():
    large = _pages(30_000_000)
    del large
    before = process_memory.held_memory(reset=True)
    rested = process_memory.peak_memory() - before
    held = _pages(10_000_000)
    assert rested < 40.0
    assert 70.0 < process_memory.peak_memory() - before - rested < 120.0, "80 MB of doubles are 76 MiB"
    del held


def test_refusals():
    with pytest.raises(VsfError, match="at least 1, 1 and 2"):
        Workload.of(100, 0, 3)
