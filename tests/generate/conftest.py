import pytest

from vsfsim.generate.workers import make_one


@pytest.fixture
def here(monkeypatch):
    """Views are made in this process, one after the other."""
    def make_each(jobs, *, device, **_):
        for job in jobs:
            make_one(job, device)
            yield job.name

    monkeypatch.setattr("vsfsim.generate.on_solids.make_each", make_each)
