"""`vsfsim measure promise`: what touches under all settings say of a goal."""

import re

import numpy as np
import pytest

from measurements import promise
from measurements.promise import row_of
from vsfsim.core.errors import VsfsimError
from vsfsim.generate.trade.buy import PILOT, Tried

STEPS = ["coarsest", "coarse", "own", "fine", "finest"]


def touches(count, last=0.008):
    """Whose errors are 24, 12, 6, 3 and 0.8 % and half of that in turn, under settings that take 0.5 to 8 s; a
    reference takes 20."""
    errors = [np.array([0.24, 0.12, 0.06, 0.03, last]) * (1.0, 0.5)[k % 2] for k in range(count)]
    return [Tried(np.diff(-e).tolist(), e.tolist(), [0.5, 1.0, 2.0, 4.0, 8.0, 20.0]) for e in errors]


def test_the_share_that_is_kept_and_what_it_costs():
    """At 4 % the factor takes the worse touches to the third setting, the others end under the second."""
    row = row_of("blocks", 0.04, STEPS, touches(PILOT), touches(60), 5)
    assert row["kept"] == 1.0 and row["said"] == "kept" and row["single"] == "fine"
    assert row["factor"] == pytest.approx(2.0 / 3.0) and row["cost"] == pytest.approx((7.5 + 3.5) / 2.0)
    assert row["over"] == pytest.approx(5.5 / 4.0) and row["pilot"] == pytest.approx(59 * 35.5 / (5.5 * 7200))


def test_touches_that_differ_from_the_pilots_break_it():
    row = row_of("blocks", 0.04, STEPS, touches(PILOT), [
        Tried([1e-4] * 4, [0.1] * 5, [1.0] * 6)] * 10, 5)
    assert row["kept"] == 0.0 and row["said"] == "broken" and row["over"] is None and row["single"] == "none"


@pytest.mark.parametrize(("last", "said"), [(0.05, "30 of 59 .* under finest, by up to 5 %"), (np.inf, "lose a frame")])
def test_what_no_factor_keeps_is_refused_with_the_figure(last, said):
    row = row_of("blocks", 0.04, STEPS, touches(PILOT, last), touches(30), 5)
    assert "kept" not in row and row["said"].startswith("refused") and re.search(said, row["said"])


def test_the_table_of_a_scene_and_what_its_record_gives_again(monkeypatch, tmp_path):
    monkeypatch.setattr(promise, "touches", lambda *some: enumerate(touches(some[3].objects)))
    found = promise.measure(["foam-block"], 61, goals=[0.05, 0.001], out=tmp_path)
    again = promise.found_of(found.record()["promise"], found.settings)
    assert found.tables[0].text() == again.tables[0].text()
    assert "foam-block  kept" in found.text() and "refused: 1 of 1 touches" in found.text()  # the rest is not made


def test_touches_count_by_number(tmp_path, monkeypatch):
    """However they come: the dear ones, which end last, are not those of the data."""
    def some(loaded, ground, goal, request, store):
        store.put("manifest/a.touch", b"{}")
        return reversed(list(enumerate([*touches(PILOT), *touches(request.objects - PILOT, 0.03)])))

    monkeypatch.setattr(promise, "touches", some)
    (row,) = promise.measure(("foam-block",), 30, goals=(0.02,), out=tmp_path / "new").record()["promise"]
    assert (row["audits"], row["kept"]) == (30, 0.5)
    for goal, out, refused in ((5.0, "new", "--goal is 5; .* 0.05"), (0.04, __file__, "test_promise.* be (made|read)")):
        with pytest.raises(VsfsimError, match=refused):
            promise.measure(("foam-block",), 30, goals=(goal,), out=tmp_path / out)
