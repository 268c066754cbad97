"""Which commit a file says it was made by."""

import pytest

import vsfsim
from vsfsim.core.errors import VsfsimError
from vsfsim.data import provenance

COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """vsfsim in a folder without .git."""
    monkeypatch.setattr(vsfsim, "__file__", str(tmp_path / "vsfsim" / "__init__.py"))
    monkeypatch.delenv(provenance.VARIABLE, raising=False)
    provenance.commit.cache_clear()
    yield tmp_path
    provenance.commit.cache_clear()


def test_a_copy_knows_its_commit_only_if_it_is_told(copy, monkeypatch):
    assert provenance.commit() is None
    provenance.commit.cache_clear()
    monkeypatch.setenv(provenance.VARIABLE, "")  # as the Dockerfile sets it without --build-arg
    assert provenance.commit() is None
    for said in (COMMIT, f"{COMMIT}+changes"):
        provenance.commit.cache_clear()
        monkeypatch.setenv(provenance.VARIABLE, said)
        assert provenance.made_by() == {"vsfsim": vsfsim.__version__, "commit": said}


def test_what_is_no_commit_is_refused(copy, monkeypatch):
    monkeypatch.setenv(provenance.VARIABLE, "main")
    with pytest.raises(VsfsimError, match="VSFSIM_COMMIT is 'main', which is no commit"):
        provenance.commit()
