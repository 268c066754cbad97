"""`vsfsim measure methods`: the literal forms give the same answers, and what would not fit is not tried."""

import json
import mmap

import numpy as np
import pytest
from scipy import optimize, sparse

from measurements import estimators as side_by_side
from measurements import fields as bench_fields
from measurements.estimators import batch, batch_dense
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


def test_the_fields_are_compared_on_one_case():
    rows = bench_fields.compare(iterations=2, rate=1e-3, points=(200,), scale=0.06, fresh=True, grid_iterations=2)
    assert [row.name for row in rows] == ["point VSF, batch", "point VSF, filter", "neural VSF", "grid VSF (ours)"]
    assert all(0.0 < row.f1 <= 1.0 and row.seconds > 0.0 and row.kilobytes > 0.0 for row in rows)
    text = bench_fields.table(rows, "fields", "a title").text()
    assert "N = 32, B = 300, rate 0.001" in text and text.startswith("a title")


def test_refusals():
    with pytest.raises(VsfError, match="at least 1, 1 and 2"):
        Workload.of(100, 0, 3)


def test_an_exported_workload_gives_an_outsider_the_same_answer(tmp_path):
    """The matrices, readings, noise and prior in the files are all that eq. 16 needs."""
    load = Workload.of(60, 2, 3)
    load.export(tmp_path / "new" / "folder")
    given = json.loads((tmp_path / "new" / "folder" / "readings.json").read_text())
    z = np.load(tmp_path / "new" / "folder" / "readings.npz")
    for name, mine in (("pressure", batch), ("dense", batch_dense)):
        w = sparse.load_npz(tmp_path / "new" / "folder" / f"{name}.npz").toarray()
        a = np.concatenate([w / given["noise_std_N"], np.eye(w.shape[1]) / given["prior_std_N_per_m"]])
        b = np.concatenate([z[name] / given["noise_std_N"],
                            np.full(w.shape[1], given["prior_mean_N_per_m"] / given["prior_std_N_per_m"])])
        np.testing.assert_allclose(optimize.nnls(a, b)[0], mine(load)[1], rtol=1e-6, atol=1e-6)
    assert w.shape[0] == len(z["touch"]) * given["rows_of_a_frame"] == 6 * given["rows_of_a_frame"]
    (tmp_path / "file").write_text("")
    with pytest.raises(VsfError, match="cannot be written"):
        load.export(tmp_path / "file" / "folder")
