"""The weekly page: a line a whole day, the newest first, with the shares and the time of the two commands' records."""

import importlib.util
import json
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def weekly():
    spec = importlib.util.spec_from_file_location("make_weekly", Path(__file__).parents[2] / "docs" / "make_weekly.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_line_a_day_that_is_whole(weekly, tmp_path):
    for date, converged, cpu in (("2026-11-20", 0.84, 20.0), ("2026-11-27", 0.869, 12.34), ("2026-11-28", 0.9, None)):
        day = tmp_path / f"{date}-0123456"
        day.mkdir()
        share = {"number": 534, "converged": converged, "wrong in silence": 0.002, "crashed": None,
                 "over the limit": 0.01}
        (day / "stability.json").write_text(json.dumps({"shares": [share]}))
        if cpu is not None:
            solver = {"version": "0.2.0", "commit": "0123456789", "machine": "x86_64, 2 CPU cores"}
            (day / "solver.json").write_text(json.dumps({**solver, "total": [{"cpu": cpu}]}))
    found = weekly.weeks(tmp_path)
    assert found == [
        ["2026-11-27", "0.2.0 0123456", "x86_64, 2 CPU cores", "534", "86.9 %", "1.2 %", "12.3 s"],
        ["2026-11-20", "0.2.0 0123456", "x86_64, 2 CPU cores", "534", "84.0 %", "1.2 %", "20.0 s"]]
    page = weekly.page({"stability": "shares\n", "solver": "times\n"}, found)
    assert page.count("\n| ") == 4 and "```text\nshares\n```" in page


def test_the_names_of_outcomes_are_those_of_the_records(weekly):
    from measurements.stability.report import measurement

    record = measurement([], {"limit": 10.0}).record()
    line = weekly.row("2026-11-27", {"shares": [{**record["shares"][0], "converged": 1.0, "wrong in silence": 0.5,
                                                 "crashed": 0.25, "over the limit": 0.125}]},
                      {"version": "0", "commit": "", "machine": "", "total": [{"cpu": 1.0}]})
    assert set(record["shares"][0]) >= {"converged", "wrong in silence", "crashed", "over the limit"}
    assert line[5] == "87.5 %"
