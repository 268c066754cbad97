"""A finished dataset is copied from an archive if it has the digest of a task's record, whole or not at all."""

import json
import shutil

import pytest
from mock_dataset import written

from vsfsim.core import shelf
from vsfsim.core.errors import DatasetError
from vsfsim.data import archive
from vsfsim.data.dataset import Dataset

NAME = "toy-v1"


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """An archive with one dataset, whose digest is known."""
    made = written(tmp_path / "archive" / NAME, train=0, test=2, touches=3)
    monkeypatch.setenv(archive.VARIABLE, str(tmp_path / "archive"))
    monkeypatch.setattr(archive, "digests_of", lambda name: {made.sha256} if name == NAME else set())
    return made


def test_a_dataset_with_the_digest_of_a_record_is_copied(kept, tmp_path):
    said, told = [], []
    found = archive.taken(tmp_path / "here", NAME, note=said.append, progress=lambda *now: told.append(now))
    assert found.sha256 == kept.sha256 and Dataset.open(tmp_path / "here")[1].name == kept.names()[1]
    assert "digest of the task's record" in said[0] and [done for done, *_ in told] == [0, 1]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["archive", "here"]
    assert archive.taken(tmp_path / "here", NAME) is None, "what is there is gone on with, not replaced"
    with pytest.raises(DatasetError, match="cannot be written"):
        archive.taken(tmp_path / "here" / "dataset.json" / "below", NAME)


def test_without_archive_dataset_or_digest_nothing_is_taken(kept, tmp_path, monkeypatch):
    said = []
    assert archive.taken(tmp_path / "here", "unknown-v1") is None
    monkeypatch.setattr(archive, "digests_of", lambda name: {"0" * 64})
    assert archive.taken(tmp_path / "here", NAME, note=said.append) is None and "another dataset" in said[0]
    assert archive.taken(tmp_path / "here", "missing-v1") is None
    monkeypatch.delenv(archive.VARIABLE)
    assert archive.taken(tmp_path / "here", NAME) is None
    assert [p.name for p in tmp_path.iterdir()] == ["archive"]


@pytest.mark.parametrize("gone", [False, True])
def test_a_damaged_archive_is_refused_and_leaves_nothing(kept, tmp_path, gone):
    file = tmp_path / "archive" / NAME / kept.entries[1].file
    if gone:
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(DatasetError, match=f"{kept.entries[1].file} is missing or is not the file"):
        archive.taken(tmp_path / "here", NAME)
    assert [p.name for p in tmp_path.iterdir()] == ["archive"]


def test_digests_are_those_of_the_records():
    name = "shoes-v3-mini-v1"
    record = json.loads((shelf.folder("tasks") / "records" / "fewshot-shoes-v3-mini-v1.json").read_text())
    assert archive.digests_of(name) == {record["dataset_sha256"]}
    assert archive.digests_of("nothing-v1") == set()


def test_generate_takes_it_only_for_the_recipe_of_the_task(kept, tmp_path, monkeypatch):
    from vsfsim.generate import run

    class MadeAnew(Exception):
        pass

    def made_anew(*_, **__):
        raise MadeAnew

    shutil.move(tmp_path / "archive" / NAME, tmp_path / "archive" / "shoes-v3-mini-v1")
    monkeypatch.setattr(archive, "digests_of", lambda name: {kept.sha256} if name == "shoes-v3-mini-v1" else set())
    monkeypatch.setattr(run, "jobs_of", made_anew)
    assert run.generate("shoes-v3-mini", tmp_path / "a").sha256 == kept.sha256
    for number, other in enumerate(({"seed": 3}, {"objects": 2}, {"tier": "fem"})):
        with pytest.raises(MadeAnew):
            run.generate("shoes-v3-mini", tmp_path / f"b{number}", **other)
