"""An archive of a dataset is taken whole or not at all, and only in place of the dataset that it is of."""

import zipfile
from pathlib import Path

import pytest
from mock_dataset import contents, written

from vsfsim.core.errors import DatasetError
from vsfsim.data.formats import archive
from vsfsim.data.formats.archive import unpack
from vsfsim.data.formats.export import export
from vsfsim.generate.run import generate


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("name", "message"), [
    ("", "File is not a zip file[.] Copy"), ("../../more", "more"), ("more", "announces 10 MB"),
    ("mock-0000-v0.h5", "was changed after")])
def test_a_damaged_one_is_an_error_that_leaves_nothing(tmp_path, monkeypatch, name, message):
    """The first half of one, and one with another file, or with one of 10 MB of which a zip has 10 kB."""
    monkeypatch.setattr(archive, "SMALL", 0)
    monkeypatch.setenv("VSFSIM_ARCHIVES", str(tmp_path / "archives"))
    made = written(tmp_path / "made", touches=2)
    file = export(made.path, "archive", tmp_path / "archives")
    file.write_bytes(file.read_bytes()[:None if name else 2000])
    if name:
        with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as packed:
            packed.writestr(name, bytes(10_000_000 * (name == "more")))
    with pytest.raises(DatasetError, match=f"archive {file} is not taken: .*{message}"):
        unpack(made.recipe, tmp_path / "new", print)
    assert {path.name for path in tmp_path.iterdir()} == {"made", "archives"}


def test_a_full_disk_is_no_damage(tmp_path, monkeypatch):
    monkeypatch.setenv("VSFSIM_ARCHIVES", str(tmp_path))
    export((made := written(tmp_path / "made")).path, "archive", tmp_path)
    monkeypatch.setattr(zipfile.ZipFile, "extractall", lambda *_: Path("/dev/full").write_bytes(b"x"))
    with pytest.raises(DatasetError, match=r"^'.*new' cannot be written: .*run the same command again[.]$"):
        unpack(made.recipe, tmp_path / "new", print)


def test_generate_takes_the_bytes_of_a_folder_or_an_address(generated, loaded, tmp_path, monkeypatch):
    made, said = generated("sprung", count=1), []
    file = export(made.path, "archive", tmp_path)
    for name, place in (("folder", str(tmp_path)), ("address", f"file://{tmp_path}")):
        monkeypatch.setenv("VSFSIM_ARCHIVES", place)
        generate(loaded("sprung", count=1), tmp_path / name, note=said.append)
        assert f"{tmp_path / name} is unpacked from {place}/{file.name}" in said
        assert contents(tmp_path / name) == contents(made.path)
    export(written(tmp_path / "other").path, "archive", tmp_path / "other").rename(file)
    with pytest.raises(DatasetError, match="not taken: it holds another dataset, of scene mock"):
        generate(loaded("sprung", count=1), tmp_path / "new")
