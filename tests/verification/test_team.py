"""Jobs in worker processes: one that dies or does not end costs its own answer only; a file of answers goes on."""

import json
import os
import time

import pytest

from measurements.stability.team import Ended, Late, answers, kept, processor_time
from vsfsim.core.errors import VsfsimError


def double(job):
    if job == "dies":
        os._exit(7)
    if job == "waits":
        time.sleep(60.0)
    if job == "threads":
        return os.environ["OMP_NUM_THREADS"]
    return 2 * job


def test_a_job_that_dies_and_one_that_does_not_end_leave_the_others(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    found = dict(answers([1, "dies", 2, "waits", 3, "threads"], double, workers=2, most=4.0))
    assert found["threads"] == "1" and os.environ["OMP_NUM_THREADS"] == "7"
    assert [found[k] for k in (1, 2, 3)] == [2, 4, 6]
    assert isinstance(found["dies"], Ended) and not found["dies"].late and "code 7" in found["dies"].words
    assert found["waits"].late


def test_a_block_ends_at_its_processor_time_whatever_it_catches():
    with pytest.raises(Late), processor_time(0.1):
        while True:
            try:
                sum(range(1000))
            except Exception:  # as code that is pressed may do
                pass
    with processor_time(0.1):
        time.sleep(0.3)  # takes none


def test_a_file_goes_on_without_the_line_that_was_cut_off(tmp_path):
    file = tmp_path / "rows.jsonl"
    assert kept(file, {"seed": 1}, "vsfsim this") == []
    with file.open("a") as out:
        out.write('{"number": 4}\n{"numb')
    assert kept(file, {"seed": 1}, "vsfsim this") == [{"number": 4}] == kept(file, {}, "vsfsim this")
    with pytest.raises(VsfsimError, match="made with seed 1, and this run has 2"):
        kept(file, {"seed": 2}, "vsfsim this")
    file.write_text(json.dumps([1]))
    with pytest.raises(VsfsimError, match="not a file of `vsfsim this`"):
        kept(file, {"seed": 1}, "vsfsim this")
