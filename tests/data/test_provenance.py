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
    (copy / "vsfsim").mkdir()
    (copy / "vsfsim" / "a.py").write_text("A = 1\n")
    monkeypatch.setenv(provenance.VARIABLE, f"{COMMIT}@{provenance.code_sha256(copy)}")
    for text, said in (("A = 1\n", COMMIT), ("A = 2\n", f"{COMMIT}+changes")):
        (copy / "vsfsim" / "a.py").write_text(text)
        provenance.commit.cache_clear()
        assert provenance.made_by() == {"vsfsim": vsfsim.__version__, "commit": said}


@pytest.mark.parametrize("said", ["main", COMMIT, f"{COMMIT}+changes"])
def test_what_is_no_commit_and_digest_is_refused(copy, monkeypatch, said):
    monkeypatch.setenv(provenance.VARIABLE, said)
    with pytest.raises(VsfsimError, match="which is no commit and digest"):
        provenance.commit()


def test_an_installed_copy_has_the_digest_of_its_checkout(tmp_path):
    for root, folders in ((tmp_path / "checkout", ("vsfsim", "scenes", "tasks")),
                          (tmp_path / "wheel", ("vsfsim", "vsfsim/scenes", "vsfsim/tasks"))):
        for name in folders:
            (root / name).mkdir(parents=True)
            (root / name / "x.py").write_text(name.rpartition("/")[2])
        (root / "vsfsim" / "__pycache__").mkdir()
    assert provenance.code_sha256(tmp_path / "checkout") == provenance.code_sha256(tmp_path / "wheel")
