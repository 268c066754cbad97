"""Jobs in worker processes: one that dies or does not end costs its own answer only; a file of answers goes on."""

import os
import time

import pytest

from measurements.stability.team import Ended, Late, answers, processor_time


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
